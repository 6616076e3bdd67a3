from .draws import (
    MotionDraws as MotionDraws,
)
from .draws import (
    library_versions as library_versions,
)
from .draws import (
    settings_of as settings_of,
)
from .likelihoods import (
    EntryNoise as EntryNoise,
)
from .likelihoods import (
    Joints3D as Joints3D,
)
from .likelihoods import (
    Keypoints2D as Keypoints2D,
)
from .likelihoods import (
    LinearObservation as LinearObservation,
)
from .noise_schedule import NoiseSchedule as NoiseSchedule
from .noise_schedule import PosteriorStep as PosteriorStep
from .posterior import MotionPosterior as MotionPosterior
from .problem import (
    Problem as Problem,
)
from .problem import (
    ScoresGeneration as ScoresGeneration,
)
from .problem import (
    simulated as simulated,
)
from .protocols import (
    ChecksEvidence as ChecksEvidence,
)
from .protocols import (
    ComparesViews as ComparesViews,
)
from .protocols import (
    DenoiserCovariance2D as DenoiserCovariance2D,
)
from .protocols import (
    DenoiserCovariance3D as DenoiserCovariance3D,
)
from .protocols import (
    Denoises2D as Denoises2D,
)
from .protocols import (
    Denoises3D as Denoises3D,
)
from .protocols import (
    DenoisesCoordinates as DenoisesCoordinates,
)
from .protocols import (
    ExactPosterior as ExactPosterior,
)
from .protocols import (
    HasCoordinateSpeeds as HasCoordinateSpeeds,
)
from .protocols import (
    HasExactPosterior as HasExactPosterior,
)
from .protocols import (
    HasInferenceNetwork as HasInferenceNetwork,
)
from .protocols import (
    HasLogDensity as HasLogDensity,
)
from .protocols import (
    HasSeeds as HasSeeds,
)
from .protocols import (
    InferenceNetwork as InferenceNetwork,
)
from .protocols import (
    Likelihood as Likelihood,
)
from .protocols import (
    Marginalises as Marginalises,
)
from .protocols import (
    MotionInference as MotionInference,
)
from .protocols import (
    MotionPrior as MotionPrior,
)
from .protocols import (
    NotConjugate as NotConjugate,
)
from .protocols import (
    Samplable as Samplable,
)
from .reference import (
    HasPositionDensity as HasPositionDensity,
)
from .reference import (
    KeptReference as KeptReference,
)
from .reference import (
    fingerprint_of as fingerprint_of,
)
from .reference import (
    log_density_at as log_density_at,
)
from .sampling import (
    Interrupted as Interrupted,
)
from .sampling import (
    Sampler as Sampler,
)
from .sampling import (
    UnsupportedPosterior as UnsupportedPosterior,
)
from .sampling import (
    importable_samplers as importable_samplers,
)
from .sampling import (
    load_sampler as load_sampler,
)
from .sampling import (
    missing as missing,
)
from .sampling import (
    progress_bar as progress_bar,
)
from .sampling import (
    require as require,
)
from .sampling import (
    sampler_names as sampler_names,
)
from .sampling import (
    suited as suited,
)
from .truncation import (
    TruncatedPosterior as TruncatedPosterior,
)
from .truncation import (
    limit_for_dimension as limit_for_dimension,
)

from .draws import (
    MotionDraws as MotionDraws,
    library_versions as library_versions,
    settings_of as settings_of,
)
from .likelihoods import (
    EntryNoise as EntryNoise,
    Joints3D as Joints3D,
    Keypoints2D as Keypoints2D,
    LinearObservation as LinearObservation,
)
from .noise_schedule import NoiseSchedule as NoiseSchedule, PosteriorStep as PosteriorStep
from .posterior import MotionPosterior as MotionPosterior
from .problem import (
    Problem as Problem,
    ScoresGeneration as ScoresGeneration,
    simulated as simulated,
)
from .protocols import (
    ChecksObservations as ChecksObservations,
    ComparesViews as ComparesViews,
    DenoiserCovariance2D as DenoiserCovariance2D,
    DenoiserCovariance3D as DenoiserCovariance3D,
    Denoises2D as Denoises2D,
    Denoises3D as Denoises3D,
    DenoisesCoordinates as DenoisesCoordinates,
    ExactPosterior as ExactPosterior,
    HasCoordinateSpeeds as HasCoordinateSpeeds,
    HasExactPosterior as HasExactPosterior,
    HasInferenceNetwork as HasInferenceNetwork,
    HasLogDensity as HasLogDensity,
    HasSeeds as HasSeeds,
    InferenceNetwork as InferenceNetwork,
    Likelihood as Likelihood,
    Marginalises as Marginalises,
    MotionInference as MotionInference,
    MotionPrior as MotionPrior,
    NotConjugate as NotConjugate,
    Samplable as Samplable,
)
from .reference import (
    HasPositionDensity as HasPositionDensity,
    StoredReference as StoredReference,
    fingerprint_of as fingerprint_of,
    log_density_at as log_density_at,
)
from .sampling import (
    Interrupted as Interrupted,
    Sampler as Sampler,
    UnsupportedPosterior as UnsupportedPosterior,
    importable_samplers as importable_samplers,
    load_sampler as load_sampler,
    missing as missing,
    progress_bar as progress_bar,
    require as require,
    sampler_names as sampler_names,
    suited as suited,
)
from .truncation import (
    TruncatedPosterior as TruncatedPosterior,
    limit_for_dimension as limit_for_dimension,
)

from .draws import MotionDraws as MotionDraws
from .finished import FinishedDraws as FinishedDraws
from .likelihoods import Joints3D as Joints3D, Keypoints2D as Keypoints2D
from .noise_schedule import NoiseSchedule as NoiseSchedule
from .posterior import MotionPosterior as MotionPosterior
from .problem import Problem as Problem, simulated as simulated
from .protocols import (
    ChecksObservations as ChecksObservations,
    ComparesViews as ComparesViews,
    DenoiserCovariance2D as DenoiserCovariance2D,
    DenoiserCovariance3D as DenoiserCovariance3D,
    Denoises2D as Denoises2D,
    Denoises3D as Denoises3D,
    DenoisesCoordinates as DenoisesCoordinates,
    ExactPosterior as ExactPosterior,
    HasConditional as HasConditional,
    HasCoordinateSpeeds as HasCoordinateSpeeds,
    HasExactPosterior as HasExactPosterior,
    HasInferenceNetwork as HasInferenceNetwork,
    HasLogDensity as HasLogDensity,
    HasManifold as HasManifold,
    HasMotionDensity as HasMotionDensity,
    HasSeeds as HasSeeds,
    HasStyles as HasStyles,
    HasWalks as HasWalks,
    InferenceNetwork as InferenceNetwork,
    Likelihood as Likelihood,
    Marginalises as Marginalises,
    MotionInference as MotionInference,
    MotionPrior as MotionPrior,
    NotConjugate as NotConjugate,
    OrthographicOnly as OrthographicOnly,
    Samplable as Samplable,
    Walks as Walks,
)
from .reference import StoredReference as StoredReference
from .sampling import (
    Interrupted as Interrupted,
    Sampler as Sampler,
    UnsupportedPosterior as UnsupportedPosterior,
    load_sampler as load_sampler,
    require as require,
    sampler_names as sampler_names,
)
from .streams import open_draws as open_draws, stream_draws as stream_draws
from .truncation import TruncatedPosterior as TruncatedPosterior

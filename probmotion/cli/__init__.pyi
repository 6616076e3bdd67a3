from .compare import Clips as Clips, Compare as Compare
from .files import Convert as Convert, Show as Show, file_called as file_called
from .main import List as List
from .reference import Reference as Reference
from .settings_options import (
    object_from_text as object_from_text,
    objects_as_words as objects_as_words,
    option_name as option_name,
    presets_of as presets_of,
    sampler_called as sampler_called,
    settings_of_samplers as settings_of_samplers,
    text_of_object as text_of_object,
)
from .summaries import (
    Summary as Summary,
    kind_of_network as kind_of_network,
    summarise as summarise,
)
from .track_options import TrackData as TrackData, learning_tracks as learning_tracks
from .train import (
    TRAINABLE as TRAINABLE,
    TrainDiffusion as TrainDiffusion,
    TrainEvaluator as TrainEvaluator,
    TrainLifter as TrainLifter,
)
from .train_bodies import (
    TrainDenoiser as TrainDenoiser,
    TrainDVAE as TrainDVAE,
    learning_clips as learning_clips,
)
from .train_motion_vae import TrainMotionVAE as TrainMotionVAE
from .training_options import (
    Steps as Steps,
    check_enough_clips as check_enough_clips,
    check_out as check_out,
    listed as listed,
    run_training as run_training,
)
from .which import Which as Which

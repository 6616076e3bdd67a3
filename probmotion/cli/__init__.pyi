from .compare import Clips as Clips
from .compare import Compare as Compare
from .files import Convert as Convert
from .files import Show as Show
from .files import file_called as file_called
from .main import List as List
from .reference import Reference as Reference
from .settings_options import (
    object_from_text as object_from_text,
)
from .settings_options import (
    objects_as_words as objects_as_words,
)
from .settings_options import (
    option_name as option_name,
)
from .settings_options import (
    presets_of as presets_of,
)
from .settings_options import (
    sampler_called as sampler_called,
)
from .settings_options import (
    settings_of_samplers as settings_of_samplers,
)
from .settings_options import (
    text_of_object as text_of_object,
)
from .summaries import (
    Summary as Summary,
)
from .summaries import (
    kind_of_network as kind_of_network,
)
from .summaries import (
    summarise as summarise,
)
from .track_options import TrackData as TrackData
from .track_options import learning_tracks as learning_tracks
from .train import (
    TRAINABLE as TRAINABLE,
)
from .train import (
    TrainDiffusion as TrainDiffusion,
)
from .train import (
    TrainEvaluator as TrainEvaluator,
)
from .train import (
    TrainLifter as TrainLifter,
)
from .train_bodies import (
    TrainDenoiser as TrainDenoiser,
)
from .train_bodies import (
    TrainDVAE as TrainDVAE,
)
from .train_bodies import (
    learning_clips as learning_clips,
)
from .train_motion_vae import TrainMotionVAE as TrainMotionVAE
from .training_options import (
    Steps as Steps,
)
from .training_options import (
    check_enough_clips as check_enough_clips,
)
from .training_options import (
    check_out as check_out,
)
from .training_options import (
    listed as listed,
)
from .training_options import (
    run_training as run_training,
)
from .which import Which as Which

from .checkpoints import (
    MODEL as MODEL,
)
from .checkpoints import (
    WEIGHTS as WEIGHTS,
)
from .checkpoints import (
    Checkpoint as Checkpoint,
)
from .checkpoints import (
    CheckpointError as CheckpointError,
)
from .checkpoints import (
    load_checkpoint as load_checkpoint,
)
from .checkpoints import (
    load_weights as load_weights,
)
from .checkpoints import (
    save_checkpoint as save_checkpoint,
)
from .checkpoints import (
    weights_digest as weights_digest,
)
from .runs import (
    LOSSES as LOSSES,
)
from .runs import (
    STATE as STATE,
)
from .runs import (
    Run as Run,
)
from .runs import (
    check_same_run as check_same_run,
)
from .runs import (
    keep_run as keep_run,
)
from .runs import (
    resume_run as resume_run,
)
from .runs import (
    steps_taken as steps_taken,
)
from .settings import TrainingSettings as TrainingSettings
from .standardisation import Standards as Standards
from .track_batches import (
    Augmentation as Augmentation,
)
from .track_batches import (
    Batch as Batch,
)
from .track_batches import (
    TrackBatches as TrackBatches,
)
from .track_batches import (
    describe_tracks as describe_tracks,
)
from .track_batches import (
    learning_and_held_out as learning_and_held_out,
)
from .trainer import (
    Anneals as Anneals,
)
from .trainer import (
    Diverged as Diverged,
)
from .trainer import (
    Trainee as Trainee,
)
from .trainer import (
    TrainingResult as TrainingResult,
)
from .trainer import (
    check_device as check_device,
)
from .trainer import (
    train as train,
)

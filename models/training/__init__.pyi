from .checkpoints import (
    MODEL as MODEL,
    WEIGHTS as WEIGHTS,
    Checkpoint as Checkpoint,
    CheckpointError as CheckpointError,
    load_checkpoint as load_checkpoint,
    load_weights as load_weights,
    save_checkpoint as save_checkpoint,
    weights_digest as weights_digest,
)
from .runs import (
    LOSSES as LOSSES,
    STATE as STATE,
    Run as Run,
    check_same_run as check_same_run,
    keep_run as keep_run,
    resume_run as resume_run,
    steps_taken as steps_taken,
)
from .settings import TrainingSettings as TrainingSettings
from .standardisation import Standards as Standards
from .track_batches import (
    Augmentation as Augmentation,
    Batch as Batch,
    TrackBatches as TrackBatches,
    describe_tracks as describe_tracks,
    learning_and_held_out as learning_and_held_out,
)
from .trainer import (
    Anneals as Anneals,
    Diverged as Diverged,
    Trainee as Trainee,
    TrainingResult as TrainingResult,
    check_device as check_device,
    train as train,
)

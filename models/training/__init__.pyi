from .checkpoints import (
    WEIGHTS as WEIGHTS,
    Checkpoint as Checkpoint,
    CheckpointError as CheckpointError,
    load_checkpoint as load_checkpoint,
    save_checkpoint as save_checkpoint,
)
from .devices import check_device as check_device
from .settings import TrainingSettings as TrainingSettings
from .standardisation import Standards as Standards
from .track_batches import Augmentation as Augmentation, TrackBatches as TrackBatches
from .trainer import (
    Diverged as Diverged,
    Trainee as Trainee,
    TrainingResult as TrainingResult,
    train as train,
)

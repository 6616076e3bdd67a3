from .inference import reconstruct as reconstruct
from .result import Reconstruction as Reconstruction

from .compare import Compare as Compare
from .denoise import Denoise as Denoise
from .files import Convert as Convert, Show as Show
from .lift import Lift as Lift, Reconstruct as Reconstruct
from .main import List as List
from .pairs import Pairs as Pairs
from .reference import Reference as Reference
from .train import TRAINABLE as TRAINABLE
from .which import Which as Which

"""Lets worker processes import the toy samplers: a spawned process is given ``sys.path``."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

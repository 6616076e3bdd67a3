"""Lets these tests, and worker processes, import the comparison's toy samplers."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "comparison"))

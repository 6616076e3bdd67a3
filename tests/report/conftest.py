"""Lets these tests, and worker processes, import the comparison's toy samplers and the browser."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "comparison"))
sys.path.insert(0, str(Path(__file__).parent))

"""What an adapter says of the inside of a prediction: its stages, its values, its choices.

Nothing is imported here but Python's standard library, and nothing is done until somebody listens.
"""

from pytest_cpas.stages.clock import StageClock, Timed, listener, listening, stage
from pytest_cpas.stages.taps import Listener, draw, heard_by, hearing, tap
from pytest_cpas.stages.torch_taps import TorchTaps

__all__ = [
    "Listener",
    "StageClock",
    "Timed",
    "TorchTaps",
    "draw",
    "heard_by",
    "hearing",
    "listener",
    "listening",
    "stage",
    "tap",
]

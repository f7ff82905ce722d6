"""Blackbox Gradient Sensing: an evolution-strategy optimiser that knows nothing of robots."""

from bgs import optimizers as optimizers
from bgs.normalizer import ObservationStatistics as ObservationStatistics
from bgs.strategy import BGSConfig as BGSConfig
from bgs.strategy import BGSInfo as BGSInfo
from bgs.strategy import BGSState as BGSState
from bgs.strategy import Population as Population
from bgs.strategy import ask as ask
from bgs.strategy import init as init
from bgs.strategy import perturb as perturb
from bgs.strategy import tell as tell

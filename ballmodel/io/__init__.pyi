from .aimy import read_aimy as read_aimy
from .csv import read_csv as read_csv
from .deepmind import MeasuredStates as MeasuredStates
from .deepmind import read_deepmind as read_deepmind
from .formats import FORMATS as FORMATS
from .formats import read as read
from .mcap import read_mcap as read_mcap
from .mcap import write_mcap as write_mcap

"""Readers of measured balls: CSV, MCAP, the DeepMind ball states, the AIMY launcher."""

from ballmodel.importers.aimy import read_aimy as read_aimy
from ballmodel.importers.csv_file import read_csv as read_csv
from ballmodel.importers.deepmind import MeasuredStates as MeasuredStates
from ballmodel.importers.deepmind import read_deepmind as read_deepmind
from ballmodel.importers.formats import FORMATS as FORMATS
from ballmodel.importers.formats import read as read
from ballmodel.importers.mcap_file import read_mcap as read_mcap
from ballmodel.importers.mcap_file import write_mcap as write_mcap

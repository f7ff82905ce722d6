"""Readers of measured balls: CSV, MCAP, the DeepMind ball states, the AIMY launcher."""

from ballmodel.io.aimy import read_aimy as read_aimy
from ballmodel.io.csv import read_csv as read_csv
from ballmodel.io.deepmind import MeasuredStates as MeasuredStates
from ballmodel.io.deepmind import read_deepmind as read_deepmind
from ballmodel.io.formats import FORMATS as FORMATS
from ballmodel.io.formats import read as read
from ballmodel.io.mcap import read_mcap as read_mcap
from ballmodel.io.mcap import write_mcap as write_mcap

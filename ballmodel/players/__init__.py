"""The paper's players and ablation distributions, as YAML tables in this folder."""

from ballmodel.players.catalogue import Skill as Skill
from ballmodel.players.catalogue import load as load
from ballmodel.players.catalogue import names as names
from ballmodel.players.catalogue import resolve as resolve
from ballmodel.players.catalogue import skill as skill

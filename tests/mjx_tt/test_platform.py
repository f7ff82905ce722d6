"""Settings of JAX before it starts: XLA's flag for processors, which compilers for accelerators cannot bear."""

from __future__ import annotations

import os
import subprocess
import sys
from importlib import metadata
from pathlib import Path

FLAG = "--xla_disable_hlo_passes=cse_barrier_expander"
CONFIGURE = "import os; from mjx_tt import platform; platform.configure(); print(os.environ['XLA_FLAGS'])"


def flags(path: Path, **environment: str) -> str:
    """XLA_FLAGS of a process after ``configure``, with what is installed in ``path``."""
    kept = {key: value for key, value in os.environ.items() if key not in ("JAX_PLATFORMS", "XLA_FLAGS")}
    found = os.pathsep.join([str(path), str(Path(__file__).parents[2])])
    run = [sys.executable, "-c", CONFIGURE]
    environment = kept | {"PYTHONPATH": found, "XLA_FLAGS": "--xla_cpu_enable_fast_math=false"} | environment
    return subprocess.run(run, env=environment, capture_output=True, text=True, check=True, timeout=120).stdout


def test_an_installed_accelerator_is_spared_the_flag_of_processors(tmp_path):
    plugin = tmp_path / "some_accelerator-1.0.dist-info"
    plugin.mkdir()
    (plugin / "METADATA").write_text("Metadata-Version: 2.1\nName: some-accelerator\nVersion: 1.0\n")
    (plugin / "entry_points.txt").write_text("[jax_plugins]\nsome_accelerator = some_accelerator\n")
    own = "--xla_cpu_enable_fast_math=false"
    assert flags(tmp_path).split() == [own]
    # Where JAX is told to compute on the processor, it has the flag, beside those that were there.
    assert flags(tmp_path, JAX_PLATFORMS="cpu").split() == [own, FLAG]
    if not metadata.entry_points(group="jax_plugins"):  # none is really there
        assert flags(tmp_path / "nothing").split() == [own, FLAG]

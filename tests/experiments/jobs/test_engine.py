"""Both engines: the same jobs in the same order with the same bits, through errors, stops and kills."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml

from experiments.config import site
from experiments.errors import RunError
from experiments.jobs import engine
from experiments.jobs.engine import Job, Setup
from experiments.jobs.heartbeat import HEARTBEAT, STOP, Heartbeat
from experiments.jobs.site import Workers
from tests.support import one_node_slurm
from tests.support.paths import ROOT
from tests.support.small_jobs import lines
from tests.support.tiny_experiment import NO_FILMS, PROGRAM, wait_for, write_tiny

HERE = {"provider": {"kind": "local"}, "workers_per_node": 2, "memory_per_worker": 0.5, "pin": True}
needs_two = pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="two workers need a core each: one is here")
SEEDS = "0,1,2"
# Jobs of tests by a process of its own: it gets signals.
DRIVER = """
import json, sys
from pathlib import Path
from experiments.config import site
from experiments.jobs import engine
from experiments.jobs.site import Workers
folder, given, deeds = Path(sys.argv[1]), json.loads(sys.argv[2]), json.loads(sys.argv[3])
workers = Workers(1, site.load(given)) if given else Workers(2)
setup = engine.Setup("tests.support.small_jobs:prepare", (folder,))
jobs = [engine.Job(name, (name, deed)) for name, deed in deeds.items()]
try:
    engine.run(workers.engine(setup, folder), jobs, lambda job, text: print(text, flush=True))
except KeyboardInterrupt as stopped:
    print("stopped:", stopped, flush=True)
    sys.exit(130)
"""


def site_file(folder: Path, **changes) -> Path:
    path = folder / "here.yaml"
    path.write_text(yaml.safe_dump(HERE | changes))
    return path


def workers(kind: str, folder: Path, **changes) -> Workers:
    """Two, of the process pool or of Parsl."""
    if kind == "pool":
        return Workers(2)
    return Workers(1, site.load(site_file(folder, **changes)), "here.yaml")


def do(kind: str, folder: Path, jobs: list[Job], failed: Callable | None = None, **changes) -> dict[str, str]:
    results: dict[str, str] = {}
    setup = Setup("tests.support.small_jobs:prepare", (folder,))
    chosen = workers(kind, folder, **changes)
    engine.run(chosen.engine(setup, folder), jobs, lambda job, text: results.update({job.name: text}), failed)
    return results


def job(name: str, deed: str = "", **rest) -> Job:
    return Job(name, (name, deed), **rest)


# -- the order of jobs ------------------------------------------------------------------------------------------------


def test_jobs_wait_for_what_they_come_after_and_for_their_programs_first(tmp_path):
    """By the choice itself, in which nothing is started."""
    mark = tmp_path / "compiled"
    a, b = (job(name, program="p", compiled=mark) for name in "ab")
    c, d = job("c", after=frozenset("a")), job("d", program="q")

    def ready(waiting: list[Job], running: list[Job], warm: set[str]) -> str:
        return "".join(j.name for j in engine._ready(waiting, running, warm))

    assert ready([a, b, c, d], [], set()) == "ad", "b waits for a's program, c for a's end"
    mark.touch()
    assert ready([b, c, d], [a], set()) == "d", "an empty file is no sign"
    mark.write_text("measured")
    assert ready([b, c, d], [a], set()) == "bd"
    assert ready([b, c], [], {"p"}) == "bc"


def test_heartbeats_of_dead_processes_are_removed_and_those_of_a_living_one_stay(tmp_path):
    living = Heartbeat(tmp_path)
    dead = tmp_path / "1234-0"
    (dead / "doing").mkdir(parents=True)
    (dead / HEARTBEAT).write_text("17")
    other = Heartbeat(tmp_path)
    assert living.folder.exists() and not dead.exists()
    (living.folder / STOP).touch()
    assert living.asked_to_stop() and not other.asked_to_stop()
    living.stop()
    assert (living.folder / HEARTBEAT).read_text().strip() == "stop"
    living.close(keep=False)
    other.close(keep=True)
    assert [path.name for path in tmp_path.iterdir()] == [other.folder.name]
    assert not (other.folder / HEARTBEAT).exists(), "its workers end"


@pytest.mark.slow
@pytest.mark.parametrize("gone, status, said", [(True, 1, ""), (False, 0, "saved")])
def test_a_worker_ends_when_nobody_waits_for_it_and_saves_when_the_heartbeat_stays_away(gone, status, said, tmp_path):
    code = """
import sys, time
from pathlib import Path
from experiments.jobs import heartbeat
from experiments.interrupts import sigterm_interrupts
heartbeat.PERIOD, heartbeat.TIMEOUT = 0.5, 2.0
watch = heartbeat.Watchdog(Path(sys.argv[1]))
try:
    with watch.doing("a/b"), sigterm_interrupts():
        time.sleep(60.0)
except KeyboardInterrupt:
    print("saved")
"""
    (tmp_path / "doing").mkdir()
    (tmp_path / HEARTBEAT).write_text("17")
    worker = subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], cwd=ROOT, stdout=subprocess.PIPE, text=True)
    wait_for(lambda: (tmp_path / "doing" / "a_b").exists())
    if gone:
        (tmp_path / HEARTBEAT).unlink()
    assert (worker.communicate(timeout=60)[0].strip(), worker.returncode) == (said, status)


# -- both engines -----------------------------------------------------------------------------------------------------


@pytest.mark.slow
@needs_two
@pytest.mark.parametrize("kind", ["pool", "parsl"])
def test_results_order_and_pinned_cores(kind, tmp_path):
    jobs = [job("a"), job("b", after=frozenset("a")), job("c"), job("d", after=frozenset("bc"))]
    assert do(kind, tmp_path, jobs) == {name: f"{name} done" for name in "abcd"}
    said = [line.split()[:2] for line in lines(tmp_path) if not line.startswith("worker")]
    assert said.index(["end", "a"]) < said.index(["begin", "b"])
    assert max(said.index(["end", name]) for name in "bc") < said.index(["begin", "d"])
    cores = [set(line.split()[2].split(",")) for line in lines(tmp_path) if line.startswith("worker")]
    assert len(cores) <= 2 and all(cores) and len(set.union(*cores)) == sum(map(len, cores)), "no core is shared"


@pytest.mark.slow
@needs_two
@pytest.mark.parametrize("kind", ["pool", "parsl"])
def test_an_error_stops_all_or_costs_its_own_job_alone(kind, tmp_path):
    errors: dict[str, Exception] = {}
    (tmp_path / "one").mkdir()
    done = do(kind, tmp_path / "one", [job("a"), job("b", "fail"), job("c")], lambda j, e: errors.update({j.name: e}))
    assert sorted(done) == ["a", "c"] and str(errors["b"]) == "b cannot be done"
    (tmp_path / "all").mkdir()
    with pytest.raises(ValueError, match="b cannot be done"):
        do(kind, tmp_path / "all", [job("a", "long"), job("b", "fail"), job("c")])
    assert "saved a" in lines(tmp_path / "all"), "a was asked to save and stop"
    assert sum(line.startswith("begin b") for line in lines(tmp_path / "all")) == 1, "an error of its own is no loss"


@pytest.mark.slow
@needs_two
@pytest.mark.parametrize("kind, how", [("pool", "SIGINT"), ("pool", STOP), ("parsl", "SIGINT")])
def test_a_stop_lets_the_jobs_save(kind, how, tmp_path):
    given = str(site_file(tmp_path)) if kind == "parsl" else None
    deeds = {"a": "long", "b": "long", "c": ""}
    command = [sys.executable, "-c", DRIVER, str(tmp_path), json.dumps(given), json.dumps(deeds)]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, start_new_session=True)
    try:
        wait_for(lambda: sum(line.startswith("begin") for line in lines(tmp_path)) == 2)
        if how == STOP:
            next((tmp_path / ".jobs").iterdir()).joinpath(STOP).touch()
        else:
            os.killpg(process.pid, getattr(signal, how))  # as a terminal does
        said, _ = process.communicate(timeout=120)  # its end means that no worker lives: each holds the pipe
    finally:
        process.kill()
    assert process.returncode == 130 and "a: saved" in said and "b: saved" in said, said
    assert not any("begin c" in line for line in lines(tmp_path))


@pytest.mark.slow
def test_parsl_gives_a_lost_workers_job_to_another_and_in_the_end_gives_up(tmp_path):
    """Workers end by kill -9 of themselves, of which nobody is told."""
    failed: dict[str, Exception] = {}
    jobs = [job("a", "die once"), job("b"), job("c", "die")]
    done = do("parsl", tmp_path, jobs, lambda j, e: failed.update({j.name: e}), workers_per_node=1, retries=1)
    assert done == {"a": "a done", "b": "b done"}
    assert isinstance(failed["c"], RunError) and "c: lost its worker 2 times" in str(failed["c"])
    begun = [line.split()[1] for line in lines(tmp_path) if line.startswith("begin")]
    assert (begun.count("a"), begun.count("b"), begun.count("c")) == (2, 1, 2)


@pytest.mark.slow
def test_a_site_that_gives_no_workers_says_so(tmp_path):
    with pytest.raises(RunError, match="the site gives no workers: (.|\n)*no-such-python"):
        do("parsl", tmp_path, [job("a")], workers_per_node=1, python="/no-such-python")


# -- trainings --------------------------------------------------------------------------------------------------------


def training(folder: Path, *more: str) -> list[str]:
    """The command that trains some seeds of the tiny experiment."""
    settings = {"updates": 1500, "evaluate_every": None, "checkpoint_seconds": 0.5, "devices": "auto"}
    path = write_tiny(folder, {"episodes": 16, "sim_rate": 75.0}, **settings)
    return [*PROGRAM, str(path), "--seeds", SEEDS, "--out", str(folder), *more]


@pytest.fixture(scope="module")
def by_the_pool(tmp_path_factory) -> Path:
    """Folder of runs."""
    folder = tmp_path_factory.mktemp("pool")
    done = subprocess.run(
        training(folder, "--processes", "2"), cwd=ROOT, env=NO_FILMS, capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "3 runs, 2 processes at a time" in done.stdout
    return folder / "tiny"


def assert_equal(runs: Path, reference: Path) -> None:
    for seed in SEEDS.split(","):
        ours, theirs = (folder / f"seed{seed}" for folder in (runs, reference))
        assert (ours / "artefact/params.npz").read_bytes() == (theirs / "artefact/params.npz").read_bytes()
        assert report(ours) == report(theirs)
        rows, wanted = ([json.loads(row) | {"seconds": 0} for row in open(f / "metrics.jsonl")] for f in (ours, theirs))
        assert rows == wanted


def report(run: Path) -> dict:
    """The evaluation without what names the folder and the time."""
    found = json.loads((run / "evaluation.json").read_text())
    return {key: value for key, value in found.items() if key not in ("policy", "training_seconds")}


@pytest.mark.slow
@needs_two
def test_a_batch_killed_and_resumed_by_parsl_has_the_pools_bits(by_the_pool, tmp_path):
    """kill -9 of a worker in a training, then of the process that was asked, then the same command."""
    runs = tmp_path / "tiny"
    command = training(tmp_path, "--site", str(site_file(tmp_path, memory_per_worker=1.0)))

    def begun(seed: int) -> bool:
        path = runs / f"seed{seed}" / "metrics.jsonl"
        return path.exists() and path.stat().st_size > 0

    process = subprocess.Popen(
        command, cwd=ROOT, env=NO_FILMS, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    try:
        wait_for(lambda: begun(0), process)
        (tmp_path / "killed").write_text(str(kill_the_worker_of(runs / "seed0")))
        wait_for(lambda: (runs / "seed1").exists(), process)
        time.sleep(3.0)
        assert process.poll() is None, process.communicate()[0]
    finally:
        process.kill()
        process.stdout.close()
        process.wait()
    done = subprocess.run(command, cwd=ROOT, env=NO_FILMS, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stdout + done.stderr
    assert_equal(runs, by_the_pool)
    assert not list((tmp_path / ".jobs").iterdir()), "neither the killed session's heartbeat nor this one's is left"


def kill_the_worker_of(run: Path) -> int:
    """The process that holds the run's lock; found in the system's list of locks."""
    inode = str((run / ".lock").stat().st_ino)
    holders = [line.split() for line in open("/proc/locks") if re.search(rf":{inode} ", line)]
    pid = int(holders[0][4])
    os.kill(pid, signal.SIGKILL)
    return pid


@pytest.mark.slow
@pytest.mark.skipif(one_node_slurm.missing() != "", reason=one_node_slurm.missing())
def test_a_batch_on_slurm_has_the_pools_bits(by_the_pool, tmp_path):
    provider = {"kind": "slurm", "walltime": "00:20:00", "partition": "all"}
    slurm = site_file(tmp_path, provider=provider, memory_per_worker=1.0, workers_per_node=1)
    with one_node_slurm.slurm(tmp_path / "slurm") as environment:
        command = training(tmp_path, "--site", str(slurm))
        environment |= {"MUJOCO_GL": "disable"}
        done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=900)
        left = subprocess.run(["squeue", "-h"], env=environment, capture_output=True, text=True).stdout
    assert done.returncode == 0, done.stdout + done.stderr
    assert "CG" in left or not left.strip(), "the block was given back"
    assert_equal(tmp_path / "tiny", by_the_pool)

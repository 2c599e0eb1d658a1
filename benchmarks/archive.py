"""Archives: how much sooner N workers are done than one, what the contract costs, how much memory a recording needs.

    python benchmarks/archive.py [--jobs 1 2] [--recordings 6] [--frames 40] [--rounds 3]

Recordings are copies of a rendered one (four cameras of 640x480), tracked into a folder without overlay. Numbers of workers
take turns, so that what else the computer does is shared by all; a ratio is of one turn. Processor seconds tell what workers
cost each other where the computer has not a core for each.
"""

from __future__ import annotations

import argparse
import resource
import shutil
import statistics
import tempfile
import time
from dataclasses import replace
from pathlib import Path

from sylpose.archive.contract import How, Summary, process
from sylpose.archive.processes import Processes
from sylpose.archive.recordings import Options, Recording, find_recordings
from sylpose.archive.run import run_all
from sylpose.archive.stores import place
from sylpose.archive.worker import track_recording
from sylpose.simulate import demo_scene, write_sequence

CONTRACTS = 300


def nothing(recording: Recording, folder: Path, threads: int) -> Summary:
    assert recording.name
    assert threads
    (folder / "results" / "trajectory.csv").write_text("")
    return Summary(status="done")


def measured(recording: Recording, folder: Path, threads: int) -> Summary:
    """Tracks; notes the most memory that the worker had: resident, and what the bound counts."""
    summary = track_recording(recording, folder, threads)
    lines = Path("/proc/self/status").read_text().splitlines()
    sizes = {line.partition(":")[0]: int(line.split()[1]) / 1024 for line in lines if line.endswith("kB")}
    return Summary(
        status=summary.status, frames=summary.frames, notes=(str(sizes["VmHWM"]), str(sizes["VmData"]), *summary.notes)
    )


def timed(recordings: list[Recording], folder: Path, jobs: int) -> tuple[float, float, list[Summary]]:
    """Seconds of all, the start of the workers included; processor seconds of the workers."""
    how, found = How(run=folder.name, work="benchmarks.archive:measured"), list[Summary]()
    start, before = time.monotonic(), resource.getrusage(resource.RUSAGE_CHILDREN)
    with Processes(place(folder), how, jobs) as workers:
        run_all(recordings, place(folder), how, workers, lambda _, summary: found.append(summary))
    assert all(summary.is_done for summary in found), found
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return time.monotonic() - start, spent, found


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--jobs", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--recordings", type=int, default=6)
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--rounds", type=int, default=3)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        root = Path(name)
        scene = demo_scene(frames=3 * asked.frames, turn_deg=120.0, size=(640, 480), n_cameras=4)
        write_sequence(root / "in" / "r000", replace(scene, frames=asked.frames), boxes=True)
        for k in range(1, asked.recordings):
            shutil.copytree(root / "in" / "r000", root / "in" / f"r{k:03}")
        recordings = list(find_recordings([str(root / "in")], Options(overlay=False)).recordings)
        timed(recordings[:1], root / "warm", 1)
        seconds: dict[int, list[float]] = {jobs: [] for jobs in asked.jobs}
        spent: dict[int, list[float]] = {jobs: [] for jobs in asked.jobs}
        summaries: list[Summary] = []
        for turn in range(asked.rounds):
            for jobs in asked.jobs:
                took, processor, found = timed(recordings, root / f"out-{turn}-{jobs}", jobs)
                seconds[jobs].append(took)
                spent[jobs].append(processor)
                summaries += found
        print(f"{asked.recordings} recordings of {asked.frames} frames, {asked.rounds} rounds")
        for jobs in asked.jobs:
            ratios = [one / some for one, some in zip(seconds[asked.jobs[0]], seconds[jobs], strict=True)]
            print(
                f"{jobs} workers: {statistics.median(seconds[jobs]):.1f} s, "
                f"{statistics.median(ratios):.2f} times as fast ({min(ratios):.2f} to {max(ratios):.2f}), "
                f"{statistics.median(spent[jobs]):.1f} processor seconds"
            )
        for k, what in enumerate(("resident", "data (what --memory bounds)")):
            print(f"memory of a worker, {what}: {max(float(summary.notes[k]) for summary in summaries):.0f} MB at most")
        how = How(run="a", work="benchmarks.archive:nothing")
        for what in ("contract without work", "what is done already"):
            start = time.monotonic()
            for k in range(CONTRACTS):
                process(recordings[k % len(recordings)], place(root / "contract" / str(k)), how)
            print(f"{what}: {1e3 * (time.monotonic() - start) / CONTRACTS:.2f} ms a recording")


if __name__ == "__main__":
    main()

"""Batch processing: speed-up by several workers, overhead per recording, and memory per worker.

    python benchmarks/archive.py [--jobs 1 2] [--recordings 6] [--frames 40] [--rounds 3]

The recordings are copies of a rendered one (four cameras of 640x480), tracked without overlay. The numbers of workers
alternate, so that other load affects all alike; each ratio is of one round. Processor seconds show what workers cost each
other if there are fewer cores than workers.
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

from sylpose.archive.contract import RunSettings, Summary, process_recording
from sylpose.archive.recordings import Recording, TrackingOptions, find_recordings
from sylpose.archive.run import ProcessWorkers, process_all
from sylpose.archive.worker import track_recording
from sylpose.io.stores import open_store
from sylpose.simulate import make_demo_scene, write_sequence

N_OVERHEAD_RUNS = 300


def do_nothing(recording: Recording, folder: Path, threads: int) -> Summary:
    assert recording.name
    assert threads
    (folder / "results" / "trajectory.csv").write_text("")
    return Summary(status="done")


def track_and_measure(recording: Recording, folder: Path, threads: int) -> Summary:
    """Track a recording; note the worker's peak resident memory and its data size, which --memory limits."""
    summary = track_recording(recording, folder, threads)
    lines = Path("/proc/self/status").read_text().splitlines()
    sizes = {line.partition(":")[0]: int(line.split()[1]) / 1024 for line in lines if line.endswith("kB")}
    return Summary(
        status=summary.status, frames=summary.frames, notes=(str(sizes["VmHWM"]), str(sizes["VmData"]), *summary.notes)
    )


def time_batch(recordings: list[Recording], folder: Path, jobs: int) -> tuple[float, float, list[Summary]]:
    """Process recordings; return wall seconds including the start of the workers, their processor seconds, and summaries."""
    settings, summaries = RunSettings(open_store(folder), track_and_measure), list[Summary]()
    start, usage_before = time.monotonic(), resource.getrusage(resource.RUSAGE_CHILDREN)
    with ProcessWorkers(settings, jobs) as workers:
        process_all(recordings, settings, workers, lambda _, summary: summaries.append(summary))
    assert all(summary.status == "done" for summary in summaries), summaries
    usage_after = resource.getrusage(resource.RUSAGE_CHILDREN)
    processor_time = usage_after.ru_utime + usage_after.ru_stime - usage_before.ru_utime - usage_before.ru_stime
    return time.monotonic() - start, processor_time, summaries


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--jobs", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--recordings", type=int, default=6)
    parser.add_argument("--frames", type=int, default=40)
    parser.add_argument("--rounds", type=int, default=3)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        root = Path(name)
        scene = make_demo_scene(frames=3 * arguments.frames, angle_deg=120.0, size=(640, 480), n_cameras=4)
        write_sequence(root / "in" / "r000", replace(scene, frames=arguments.frames), boxes=True)
        for k in range(1, arguments.recordings):
            shutil.copytree(root / "in" / "r000", root / "in" / f"r{k:03}")
        recordings = find_recordings([str(root / "in")], TrackingOptions(overlay=False))[0]
        time_batch(recordings[:1], root / "warm", 1)
        seconds: dict[int, list[float]] = {jobs: [] for jobs in arguments.jobs}
        processor_times: dict[int, list[float]] = {jobs: [] for jobs in arguments.jobs}
        summaries: list[Summary] = []
        for round_number in range(arguments.rounds):
            for jobs in arguments.jobs:
                wall_time, processor, found = time_batch(recordings, root / f"out-{round_number}-{jobs}", jobs)
                seconds[jobs].append(wall_time)
                processor_times[jobs].append(processor)
                summaries += found
        print(f"{arguments.recordings} recordings of {arguments.frames} frames, {arguments.rounds} rounds")
        for jobs in arguments.jobs:
            ratios = [one / several for one, several in zip(seconds[arguments.jobs[0]], seconds[jobs], strict=True)]
            print(
                f"{jobs} workers: {statistics.median(seconds[jobs]):.1f} s, "
                f"speed-up {statistics.median(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f}), "
                f"{statistics.median(processor_times[jobs]):.1f} processor seconds"
            )
        for k, description in enumerate(("resident", "data (limited by --memory)")):
            print(
                f"memory of a worker, {description}: {max(float(summary.notes[k]) for summary in summaries):.0f} MB at most"
            )
        for description in ("overhead without work", "recordings already done"):
            start = time.monotonic()
            for k in range(N_OVERHEAD_RUNS):
                settings = RunSettings(open_store(root / "contract" / str(k)), do_nothing)
                process_recording(recordings[k % len(recordings)], settings)
            print(f"{description}: {1e3 * (time.monotonic() - start) / N_OVERHEAD_RUNS:.2f} ms per recording")


if __name__ == "__main__":
    main()

"""What rounds cost on a real network on this machine, and what a node does in rigs of up to 1,000 cameras.

    python benchmarks/network.py [--nodes 2 4 8 16] [--cameras 4 16 64 256 1000] [--recording FOLDER]
    python benchmarks/network.py --tree 16 1000
    python benchmarks/network.py --latency 2 4 8 16
    python benchmarks/network.py --kills 20
    python benchmarks/network.py --soak 30

Rounds: so many processes tell each other 241 bytes, as a round of the alignment does, 500 times: milliseconds per round,
median and 99 %, and milliseconds of processor time of a node.

Cameras: what one node does in a round, without a network: milliseconds, and bytes that it hears.

With a recording (a folder that `sylpose demo` has written), processes of `sylpose node` play it as fast as they can:
milliseconds from images to the agreed pose, bytes and rounds per frame.

Each of these does nothing else: `--tree`, what a tree would carry in rigs of so many cameras; `--latency`, from a frame to
its pose with so many cameras, small pictures, in both modes; `--kills`, so many deaths of nodes at any moment; `--soak`,
memory in so many minutes.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks import network_kills, network_latency, network_soak, network_tree
from sylpose import calibration
from sylpose.network.membership import Answer, Ask, Enter, Heard, Present, Tell
from sylpose.network.rounds import agree_next, agree_start, agree_step
from sylpose.network.runner import Runner
from sylpose.network.wire_format import TELLS, message
from sylpose.network.zenoh_transport import Links, Place, Wire, watch_network

BYTES, ROUNDS = 241, 500


def talk(c: int, n: int, network: str, out: multiprocessing.Queue[tuple[FloatList, float]]) -> None:
    names = [f"cam_{k}" for k in range(n)]
    took: list[float] = []
    cpu = [0.0]

    def work(ask: Callable[[Ask, int], Answer]) -> None:
        ask(Enter(), 0)
        members, newcomers = 0, frozenset[int]()
        while members < n:
            heard = ask(Tell(bytes(8), newcomers, b"x"), 0)
            assert isinstance(heard, Heard)
            members, newcomers = len(heard.told), heard.newcomers if len(heard.told) == 1 else frozenset()
        cpu[0] = time.process_time()
        for _ in range(ROUNDS):
            begun = time.perf_counter()
            ask(Tell(bytes(BYTES)), 0)
            took.append(time.perf_counter() - begun)
        cpu[0] = time.process_time() - cpu[0]

    runner = Runner(Present(c, n, c, wait=3000), work, lambda packets: wire.send(packets))
    wire = Wire(Place(names[c], "0" * 16, network), names, Links(), runner.heard)
    runner.run(lambda _: None, lambda: False)
    wire.close()
    out.put((took, cpu[0]))


FloatList = list[float]


def rounds(n: int) -> str:
    context = multiprocessing.get_context("spawn")
    out: multiprocessing.Queue[tuple[FloatList, float]] = context.Queue()
    network = f"bench-{os.getpid()}-{n}"
    processes = [context.Process(target=talk, args=(c, n, network, out)) for c in range(n)]
    for process in processes:
        process.start()
    found = [out.get(timeout=300) for _ in processes]
    for process in processes:
        process.join()
    took = 1e3 * np.concatenate([t for t, _ in found])
    cpu = 1e3 * np.mean([c for _, c in found]) / ROUNDS
    return f"| {n} | {np.median(took):.1f} | {np.quantile(took, 0.99):.0f} | {cpu:.2f} |"


def one_node(n: int) -> str:
    """What it takes to hear all others in a round."""
    state, _ = agree_start(0, range(n), bytes(BYTES))
    took = []
    for number in range(5):
        inbox = [(c, message(TELLS, c, number, 0, bytes(BYTES))) for c in range(1, n)]
        begun = time.perf_counter()
        state, _ = agree_step(state, inbox)
        assert state.outcome is not None
        state, _ = agree_next(state, bytes(BYTES))
        took.append(1e3 * (time.perf_counter() - begun))
    return f"| {n} | {np.median(took):.2f} | {(n - 1) * (BYTES + 12) / 1e3:.1f} |"


def tracked(folder: Path, n: int) -> str:
    """Nodes that play a recording of as many cameras."""
    network, file = f"bench-{os.getpid()}-t{n}", folder / "calibration.toml"
    names = calibration.load(file).names[:n]
    states: list[dict[str, float]] = []
    session = watch_network(Links(), network, lambda _r, _n, line: states.append(json.loads(line)), lambda *_: None)
    with tempfile.TemporaryDirectory() as out:
        command = [sys.executable, "-m", "sylpose", "node", "--calibration", str(file), "--network", network]
        nodes = [
            subprocess.Popen(
                [
                    *command,
                    name,
                    "--source",
                    f"{folder / name}.mp4",
                    "--speed",
                    "0",
                    "--out",
                    f"{out}/{name}",
                    "--wait",
                    "30",
                ],
                stdout=subprocess.DEVNULL,
            )
            for name in names
        ]
        for node in nodes:
            node.wait()
    session.close()
    busy = [s for s in states if s["bytes_per_frame"] > 0 and s["frames"] > 5]
    latency = np.median([s["latency_ms"] for s in busy])
    per_frame, rate = np.median([s["bytes_per_frame"] for s in busy]), np.median([s["rate"] for s in busy])
    told = np.median([s["rounds_per_frame"] for s in busy])
    return f"| {n} | {rate:.1f} | {latency:.0f} | {per_frame / 1e3:.1f} kB | {told:.0f} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--nodes", type=int, nargs="*", default=[2, 4, 8, 16])
    parser.add_argument("--cameras", type=int, nargs="*", default=[4, 16, 64, 256, 1000])
    parser.add_argument("--recording", type=Path)
    parser.add_argument("--tree", type=int, nargs="*", default=[])
    parser.add_argument("--latency", type=int, nargs="*", default=[])
    parser.add_argument("--kills", type=int)
    parser.add_argument("--soak", type=float, metavar="MINUTES")
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    if asked.tree or asked.latency or asked.kills or asked.soak:
        if asked.tree:
            print("\n".join([network_tree.HEAD, *(network_tree.table(n, seed=asked.seed) for n in asked.tree)]))
        if asked.latency:
            print(network_latency.table(asked.latency), flush=True)
        if asked.kills:
            print(network_kills.kills(asked.kills, seed=asked.seed), flush=True)
        if asked.soak:
            print(f"{network_soak.HEAD}\n{network_soak.soak(asked.soak)}", flush=True)
        return
    print("| nodes | ms per round | 99 % | processor ms of a node |\n|---|---|---|---|", flush=True)
    for n in asked.nodes:
        print(rounds(n), flush=True)
    print("\n| cameras | ms of a node per round | kB heard |\n|---|---|---|", flush=True)
    for n in asked.cameras:
        print(one_node(n), flush=True)
    if asked.recording:
        cameras = len(calibration.load(asked.recording / "calibration.toml"))
        print("\n| nodes | frames per second | ms from images to pose | told per frame | rounds |\n" + "|---" * 5 + "|")
        print(tracked(asked.recording, cameras), flush=True)


if __name__ == "__main__":
    main()

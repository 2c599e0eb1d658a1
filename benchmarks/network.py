"""Cost of rounds on a local network, and work per node in rigs of up to 1,000 cameras.

    python benchmarks/network.py [--nodes 2 4 8 16] [--cameras 4 16 64 256 1000] [--recording FOLDER]
    python benchmarks/network.py --tree 16 1000
    python benchmarks/network.py --latency 2 4 8 16
    python benchmarks/network.py --kills 20
    python benchmarks/network.py --soak 30

--nodes: that many processes exchange 241 bytes, as in a round of the alignment, 500 times. Prints milliseconds per round
(median and 99 %) and the processor time per node and round.

--cameras: the work of one node in a round without a network. Prints milliseconds and received bytes.

--recording: processes of `sylpose node` play a recording (a folder that `sylpose demo` has written) at full speed. Prints
milliseconds from images to the agreed pose, and bytes and rounds per frame.

The other options run alone. `--tree`: traffic of a tree topology in rigs of that many cameras. `--latency`: time from a
frame to its pose with that many cameras and small images, in both modes. `--kills`: that many node failures at random
moments. `--soak`: memory over that many minutes.
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
from sylpose.io import calibration
from sylpose.network.membership import ExchangeRequest, ExchangeResult, JoinRequest, Membership, Request, Response
from sylpose.network.rounds import begin_next_round, start_rounds, step_round
from sylpose.network.runner import NodeRunner
from sylpose.network.wire_format import DATA, encode_message
from sylpose.network.zenoh_transport import LinkSettings, NodeAddress, ZenohTransport, watch_network

MESSAGE_BYTES, N_ROUNDS = 241, 500


def run_node(c: int, n: int, network: str, out: multiprocessing.Queue[tuple[FloatList, float]]) -> None:
    names = [f"cam_{k}" for k in range(n)]
    round_times: list[float] = []
    cpu = [0.0]

    def work(request: Callable[[Request, int], Response]) -> None:
        request(JoinRequest(), 0)
        members, newcomers = 0, frozenset[int]()
        while members < n:
            received = request(ExchangeRequest(bytes(8), newcomers, b"x"), 0)
            assert isinstance(received, ExchangeResult)
            members, newcomers = (
                len(received.payloads),
                received.newcomers if len(received.payloads) == 1 else frozenset(),
            )
        cpu[0] = time.process_time()
        for _ in range(N_ROUNDS):
            start_time = time.perf_counter()
            request(ExchangeRequest(bytes(MESSAGE_BYTES)), 0)
            round_times.append(time.perf_counter() - start_time)
        cpu[0] = time.process_time() - cpu[0]

    runner = NodeRunner(Membership(c, n, c, wait=3000), work, lambda packets: wire.send(packets))
    wire = ZenohTransport(NodeAddress(names[c], "0" * 16, network), names, LinkSettings(), runner.receive)
    runner.run(lambda _: None, lambda: False)
    wire.close()
    out.put((round_times, cpu[0]))


FloatList = list[float]


def measure_rounds(n: int) -> str:
    context = multiprocessing.get_context("spawn")
    out: multiprocessing.Queue[tuple[FloatList, float]] = context.Queue()
    network = f"bench-{os.getpid()}-{n}"
    processes = [context.Process(target=run_node, args=(c, n, network, out)) for c in range(n)]
    for process in processes:
        process.start()
    found = [out.get(timeout=300) for _ in processes]
    for process in processes:
        process.join()
    round_ms = 1e3 * np.concatenate([t for t, _ in found])
    cpu = 1e3 * np.mean([c for _, c in found]) / N_ROUNDS
    return f"| {n} | {np.median(round_ms):.1f} | {np.quantile(round_ms, 0.99):.0f} | {cpu:.2f} |"


def measure_one_node(n: int) -> str:
    """Measure the time of one node to process the messages of all others in a round."""
    state, _ = start_rounds(0, range(n), bytes(MESSAGE_BYTES))
    round_ms = []
    for number in range(5):
        inbox = [(c, encode_message(DATA, c, number, 0, bytes(MESSAGE_BYTES))) for c in range(1, n)]
        start_time = time.perf_counter()
        state, _ = step_round(state, inbox)
        assert state.outcome is not None
        state, _ = begin_next_round(state, bytes(MESSAGE_BYTES))
        round_ms.append(1e3 * (time.perf_counter() - start_time))
    return f"| {n} | {np.median(round_ms):.2f} | {(n - 1) * (MESSAGE_BYTES + 12) / 1e3:.1f} |"


def measure_tracking(folder: Path, n: int) -> str:
    """Run nodes that play a recording of `n` cameras and format their table row."""
    network, file = f"bench-{os.getpid()}-t{n}", folder / "calibration.toml"
    names = calibration.load(file).names[:n]
    states: list[dict[str, float]] = []
    session = watch_network(
        LinkSettings(), network, lambda _r, _n, line: states.append(json.loads(line)), lambda *_: None
    )
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
    active_states = [s for s in states if s["bytes_per_frame"] > 0 and s["frames"] > 5]
    latency = np.median([s["latency_ms"] for s in active_states])
    per_frame, rate = (
        np.median([s["bytes_per_frame"] for s in active_states]),
        np.median([s["rate"] for s in active_states]),
    )
    rounds_per_frame = np.median([s["rounds_per_frame"] for s in active_states])
    return f"| {n} | {rate:.1f} | {latency:.0f} | {per_frame / 1e3:.1f} kB | {rounds_per_frame:.0f} |"


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
    arguments = parser.parse_args()
    if arguments.tree or arguments.latency or arguments.kills or arguments.soak:
        if arguments.tree:
            print(
                "\n".join(
                    [
                        network_tree.TABLE_HEADER,
                        *(network_tree.format_rows(n, seed=arguments.seed) for n in arguments.tree),
                    ]
                )
            )
        if arguments.latency:
            print(network_latency.format_tables(arguments.latency), flush=True)
        if arguments.kills:
            print(network_kills.kills(arguments.kills, seed=arguments.seed), flush=True)
        if arguments.soak:
            print(f"{network_soak.TABLE_HEADER}\n{network_soak.soak(arguments.soak)}", flush=True)
        return
    print("| nodes | ms per round: median | 99 % | processor ms per node and round |\n|---|---|---|---|", flush=True)
    for n in arguments.nodes:
        print(measure_rounds(n), flush=True)
    print("\n| cameras | ms per node and round | kB received |\n|---|---|---|", flush=True)
    for n in arguments.cameras:
        print(measure_one_node(n), flush=True)
    if arguments.recording:
        cameras = len(calibration.load(arguments.recording / "calibration.toml"))
        print(
            "\n| nodes | frames/s | ms from images to pose | sent per frame | rounds per frame |\n" + "|---" * 5 + "|"
        )
        print(measure_tracking(arguments.recording, cameras), flush=True)


if __name__ == "__main__":
    main()

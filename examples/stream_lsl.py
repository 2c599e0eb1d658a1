"""Publish poses as Lab Streaming Layer streams, one per object: needs `pip install pylsl`.

    sylpose track bench --stream - | python examples/stream_lsl.py

Frames without a measured pose are samples of NaN. The recording's clock starts at 0, so times are shifted to LSL's clock
by the fastest arrival so far: what remains is the shortest latency of the tracker.
"""

import json
import math
import sys
from collections.abc import Iterable

import pylsl

MEASURED = ("first frame", "tracked", "relocalised")
POSITION, QUATERNION = ("tx", "ty", "tz"), ("qx", "qy", "qz", "qw")
SDS = ("rx_sd", "ry_sd", "rz_sd", "tx_sd", "ty_sd", "tz_sd")


def open_outlet(name: str, unit: str) -> pylsl.StreamOutlet:
    """Open a stream with labeled channels, as recorders such as LabRecorder store them."""
    labels = (*POSITION, *QUATERNION, *SDS)
    info = pylsl.StreamInfo(name, "MoCap", len(labels), pylsl.IRREGULAR_RATE, pylsl.cf_double64, f"sylpose {name}")
    channels = info.desc().append_child("channels")
    units = [unit or "units"] * 3 + ["quaternion"] * 4 + ["degrees"] * 3 + [unit or "units"] * 3
    for label, channel_unit in zip(labels, units, strict=True):
        channel = channels.append_child("channel")
        channel.append_child_value("label", label)
        channel.append_child_value("unit", channel_unit)
    return pylsl.StreamOutlet(info)


def publish(lines: Iterable[str]) -> None:
    """Publish lines of JSON (docs/formats.md) until they end."""
    outlets: dict[str, pylsl.StreamOutlet] = {}
    offset = math.inf
    for line in lines:
        pose = json.loads(line)
        name = pose.get("object", "object")
        if name not in outlets:
            outlets[name] = open_outlet(name, pose["unit"])
        offset = min(offset, pylsl.local_clock() - pose["time"])
        values = [math.nan] * 13
        if pose["status"] in MEASURED:
            sds = [math.inf if sd is None else sd for sd in (*pose["sigma_deg"], *pose["sigma_position"])]
            values = [*pose["position"], *pose["quaternion"], *sds]
        outlets[name].push_sample(values, pose["time"] + offset)


if __name__ == "__main__":
    publish(sys.stdin)

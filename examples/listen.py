"""Print the positions that nodes publish (docs/network.md): python examples/listen.py [SECONDS]"""

import json
import sys
import time

import zenoh

with zenoh.open(zenoh.Config()) as session:
    said = session.declare_subscriber(
        "sylpose/1/**/pose", lambda sample: print(json.loads(sample.payload.to_string())["position"])
    )
    time.sleep(float(sys.argv[1]) if len(sys.argv) > 1 else 60.0)

"""Half of the checkpoints that are uploaded are one."""

import os
import urllib.request

import schemathesis
from hypothesis import strategies as st

with urllib.request.urlopen(f"{os.environ['QEDGIX_REST']}/v1/policies/qedgix/export") as answer:
    CHECKPOINT = answer.read()

damaged = st.integers(0, len(CHECKPOINT) - 1).map(lambda at: CHECKPOINT[:at] + b"\xff" + CHECKPOINT[at + 1 :])
schemathesis.openapi.media_type("application/octet-stream", st.just(CHECKPOINT) | damaged | st.binary())

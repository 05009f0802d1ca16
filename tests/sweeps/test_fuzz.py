"""Settings of any kind: something to be built, or a SteerbenchError. `make fuzz` runs long."""

import contextlib

import pytest
from hypothesis import given
from hypothesis import strategies as st
from omegaconf import OmegaConf

from bench.errors import SteerbenchError
from sweeps.configured import build
from sweeps.overrides import CONFIGS, composed, leaves

GROUPS = {path.name for path in CONFIGS.iterdir() if path.is_dir()}
KEYS = sorted({*leaves(OmegaConf.to_container(composed(["method=steernerf"]))), *GROUPS})
SOME = (
    "|null|true|nan|inf|-1|0|0.0|1e400|1e-400|[]|{}|[1,2]|{a:1}|abc|'|\"|${seed}|${nothing}|${seed|["
    "|\0|steernerf|a,b"
)
VALUES = st.one_of(
    st.sampled_from(SOME.split("|")),
    st.floats().map(str),
    st.integers().map(str),
    st.text(max_size=12),
)
OVERRIDES = st.one_of(
    st.builds(
        "{}{}={}".format, st.sampled_from(["", "+", "++", "~"]), st.sampled_from(KEYS), VALUES
    ),
    st.text(max_size=20),
)


@pytest.mark.slow
@given(st.lists(OVERRIDES, max_size=3))
def test_any_overrides_compose_and_build_or_are_refused(overrides):
    with contextlib.suppress(SteerbenchError):
        config = composed(["method=steernerf", *overrides])
        for group in ("method", "protocol", "budget"):
            if group in config and "_target_" in (config[group] or {}):
                build(config, group)

"""Workers: programs in a folder of their own, with a copy of `steerbench_worker.py` beside them."""

import gc
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from textwrap import dedent

import pytest

from methods.external.method import External
from tests.common import ROOT

GREY = """
    import numpy as np

    from steerbench_worker import serve

    class Grey:
        def fit(self, job):
            self.level = job.background[0] / 2

        def render(self, camera):
            return np.full((camera.height, camera.width, 3), self.level)
"""


@pytest.fixture
def worker(tmp_path) -> Callable[..., Path]:
    """Write a worker: `GREY`, then further lines, the last of which serves `Grey`."""
    folder = tmp_path / "worker"

    def write(lines="", before=GREY, after="serve(Grey)\n"):
        folder.mkdir(exist_ok=True)
        shutil.copy(ROOT / "steerbench_worker.py", folder)
        (folder / "grey.py").write_text(dedent(before) + dedent(lines) + after)
        return folder / "grey.py"

    return write


@pytest.fixture
def external() -> Iterator[Callable[..., External]]:
    """Make methods whose processes have ended after the test."""

    def make(command, **settings):
        usual = {"python": None, "options": {}, "files": [], "lock": None, "seed": 3}
        usual |= {"environment": {}, "folders": []}
        limits = {"start_s": 60.0, "fit_s": 60.0, "frame_s": 60.0}
        return External(command=str(command), **{**usual, **limits, **settings})

    yield make
    gc.collect()  # tracebacks hold the methods of tests about errors

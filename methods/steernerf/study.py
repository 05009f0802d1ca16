"""What can be varied of SteerNeRF, and what its stages are; see `bench.study`."""

from __future__ import annotations

from bench.study import Study

STUDY = Study()

"""Hydra configurations and the `steerbench` command line."""

import sys
from importlib.util import find_spec
from pathlib import Path

for _name in ("bench", "methods", "reports"):  # names that a user's folder may have, too
    _found, _own = find_spec(_name), Path(__file__).parents[1] / _name
    _places = list(_found.submodule_search_locations or ()) if _found else []
    if not _places or not _own.samefile(_places[0]):
        _other = _places[0] if _places else _found.origin if _found else "none"
        sys.exit(
            f"steerbench: expected Python to find its package {_name!r} in {_own.parent}, it finds "
            f"{_other}: rename that one, or take it off the path"
        )

"""Of several runs of one job that of the present code stands, or else the one used last."""

import pytest

from sweeps import versions
from sweeps.measurement import Job
from sweeps.overrides import composed
from tests.reports.conftest import copied, rewrite

PRESENT = "of the code that is here"


@pytest.fixture
def versions_of(store, stored_run, monkeypatch):
    """A store with a run of one job for each of these codes, used in this order."""
    monkeypatch.setattr(versions, "_code", lambda things: PRESENT)
    config = Job(composed([]), []).settings

    def stored(*codes: str) -> list[str]:
        store.remove("of nobody")
        keys = [f"{number}{stored_run[1:]}" for number in range(len(codes))]
        for key, code in zip(keys, codes, strict=True):
            copied(store, stored_run, key)
            rewrite(store, key, made_of={"config": config, "code": code})
            store.use(key, "a job")
        store.remove(stored_run)
        return keys

    return stored


@pytest.mark.parametrize(
    ("codes", "taken", "said"),
    [
        ((PRESENT,), 0, None),
        (("old",), 0, None),
        ((PRESENT, "tried"), 0, "of the present code; 1 others"),  # tried, and taken back
        (("old", PRESENT, "older"), 1, "of the present code; 2 others"),
        ((PRESENT, PRESENT), 1, "of the present code; 1 others"),  # with other libraries
        (("old", "older"), 1, "the one used last; 1 others"),
    ],
)
def test_the_run_of_the_present_code_stands(store, versions_of, codes, taken, said):
    keys, lines = versions_of(*codes), []
    (run,) = versions.standing(store, lines.append)
    assert run.key == keys[taken]
    expected = said and f"several versions of a run: taken {run.key} ({said})"
    assert lines == [expected] * bool(said)
    ((found,),) = (versions.by_job(store, print)[job] for job in ["a job"])
    assert found.key == keys[taken]


def test_asking_for_a_run_makes_it_the_one_used_last(store, versions_of):
    first, _ = versions_of("old", "older")
    store.use(first, "a job")
    assert [run.key for run in versions.standing(store, print)] == [first]


def test_a_method_that_cannot_be_imported_is_not_of_the_present_code(store, versions_of):
    (key,) = versions_of(PRESENT)
    config = {"method": {"_target_": "elsewhere.Method"}}
    rewrite(store, key, made_of={"config": config, "code": PRESENT})
    (run,) = versions.standing(store, print)
    assert not versions.is_present(run)

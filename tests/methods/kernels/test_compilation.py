"""Kernels are compiled before a training is timed, and only if that has not been done."""

import pytest

from methods.instant_ngp.method import InstantNgp
from methods.kernels import compilation, cpu
from methods.kernels.compilation import compile_kernels

MARCH = "methods.kernels.march.cases"


@pytest.fixture
def computed(monkeypatch) -> list[str]:
    """The modules whose cases are computed, which is what compiles."""
    modules = []
    monkeypatch.setattr(compilation, "wrong_of", modules.append)
    return modules


def test_the_kernels_that_a_method_stands_on_are_compiled_where_there_is_no_machine_code(
    computed, monkeypatch, quiet_log
):
    monkeypatch.setattr(cpu, "is_kept", lambda function: False)
    assert compile_kernels(InstantNgp, "cpu", quiet_log) > 0
    assert MARCH in computed
    assert all(module.startswith("methods.kernels.") for module in computed)  # of no other method


def test_what_is_compiled_already_takes_no_time(computed, monkeypatch, quiet_log):
    monkeypatch.setattr(cpu, "is_kept", lambda function: True)
    assert compile_kernels(InstantNgp, "cpu", quiet_log) == 0
    assert compile_kernels(InstantNgp, "reference", quiet_log) == 0
    assert computed == []


def test_machine_code_is_known_by_the_folder_of_the_present_code(tmp_path, monkeypatch):
    from methods.kernels.march import cpu as march

    kernels = [function for function in vars(march).values() if hasattr(function, "_cache")]
    monkeypatch.setattr(kernels[0]._cache, "_folder", tmp_path / "machine-code-of-other-code")
    assert not cpu.is_kept(kernels[0])
    (tmp_path / "machine-code-of-other-code").mkdir()
    assert cpu.is_kept(kernels[0])
    assert not cpu.is_kept(len)

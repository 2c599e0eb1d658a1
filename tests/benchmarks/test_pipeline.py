"""The table of stages of the pipeline's benchmark names what exists."""

from __future__ import annotations

from importlib import import_module

from benchmarks.pipeline import STAGES, find_stage


def test_stages_consist_of_modules_and_functions_that_exist() -> None:
    for stage, places in STAGES.items():
        for place in places:
            module, _, function = place.partition(":")
            found = import_module(f"sylpose.{module}")
            assert not function or hasattr(found, function), place
            assert find_stage(module, function) == stage, place
    assert find_stage("bundle_adjustment.bundle", "minimize") is None

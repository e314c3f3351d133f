"""All combinations of parts of a scenario: a page shows it, or says why not."""

import re

import pytest
from combinations import combined, one_in

from drake_dae import build_scenario, load_scenario
from drake_dae.errors import ModelError, ScenarioError, WiringError
from drake_dae.running.bench.description import bench_of
from drake_dae.running.export.steps.boundary import loop_part
from drake_dae.scenario import build_commanded


def is_sentence(text):
    """Whether a reason is one sentence, or two; dots in numbers, names and keys are none."""
    return bool(re.fullmatch(r"[^.]+(\. [^.]+)?", re.sub(r"(?<=\w)\.(?=\w)", "_", text)))


@pytest.mark.slow
@pytest.mark.parametrize("names", one_in(129), ids=", ".join)
def test_a_page_shows_it_or_says_why_not(names, tmp_path):
    path = combined(names, tmp_path)
    try:
        build_scenario(load_scenario(path))
    except (ScenarioError, WiringError):
        return  # No scenario at all.
    chosen = load_scenario(path)
    if chosen.plant.carries:
        with pytest.raises(ScenarioError, match="CompliantContact"):
            build_commanded(chosen)
        return
    built = build_commanded(chosen)
    for reason in built.left_out:
        assert is_sentence(reason), reason
    bench = bench_of(built.loop, built.context, "bench")
    assert [len(bench.data[key]) for key in ("bodies", "constraints", "controls")] > [0, 0, 0]
    refused = ""
    try:
        loop_part(built.loop, built.context)
    except ModelError as error:
        refused = str(error)
    if refused:
        assert is_sentence(refused), refused
        changes = names[3] == "opening" or "task" in names[4]
        assert changes or names[2] in ("noise", "force"), refused

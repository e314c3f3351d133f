"""All combinations of parts of a scenario: a live bench runs, and a page too, or says why not."""

import re

import pytest
from combinations import combined, one_in

from drake_dae import build_commanded, build_scenario, load_scenario
from drake_dae.errors import ModelError, ScenarioError, WiringError
from drake_dae.running.bench.description import bench_of
from drake_dae.running.bench.run import HandRun, Sampler
from drake_dae.running.export.steps.boundary import loop_part


def is_sentence(text):
    """Whether a reason is one sentence, or two; dots in numbers, names and keys are none."""
    return bool(re.fullmatch(r"[^.]+(\. [^.]+)?", re.sub(r"(?<=\w)\.(?=\w)", "_", text)))


@pytest.mark.slow
@pytest.mark.parametrize("names", one_in(129), ids=", ".join)
def test_a_bench_runs_and_a_page_does_or_says_why_not(names, tmp_path):
    path = combined(names, tmp_path)
    try:
        build_scenario(load_scenario(path))
    except (ScenarioError, WiringError):
        return  # No scenario at all.
    chosen = load_scenario(path)
    built = build_commanded(chosen)
    for reason in built.left_out:
        assert is_sentence(reason), reason
    bench = bench_of(built.loop, built.context, "bench")
    run, sample = HandRun(built.loop, built.context, chosen.integrator), Sampler(bench)
    for number in range(3):
        run.set({run.inputs.names.index(n): 0.1 for n in run.inputs.names[:1] if number == 1})
        run.advance()
        assert None not in sample(run.context)["scene"]
    assert run.record().time[-1] == pytest.approx(0.025)
    refused = ""
    try:
        loop_part(built.loop, built.context)
    except ModelError as error:
        refused = str(error)
    if refused:
        assert is_sentence(refused), refused
        changes = names[3] in ("opening", "Drake's contact") or "task" in names[4]
        assert changes or names[2] in ("noise", "force"), refused

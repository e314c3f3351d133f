"""The same study through a Dask cluster on this machine."""

import pytest
from runs import scenario, some

import drake_dae as dd
from drake_dae.errors import ModelError

# Its own warnings are about ports and slow scheduling.
pytestmark = pytest.mark.filterwarnings("ignore")

VARIATIONS = dd.grid_variations(
    {"start.errors.tool.z": [-0.05, 0.0, 0.05, 3.0], "gains.all": [[-4.0], [-8.0]]}
)


@pytest.mark.thorough
def test_two_workers_give_the_table_of_processes(tmp_path):
    """Whoever runs them; and what processes began, a cluster ends."""
    distributed = pytest.importorskip("distributed")
    chosen = scenario("two_link_wall", "duration=0.5", "compiled=false")
    with distributed.LocalCluster(
        n_workers=2,
        threads_per_worker=1,
        host="127.0.0.1",
        dashboard_address=":0",
        scheduler_kwargs={"dashboard": False},
    ) as cluster:
        address = cluster.scheduler_address
        for rollout in (False, True):
            folder = tmp_path / f"{rollout}"
            here = dd.sweep(chosen, VARIATIONS, folder / "here.jsonl", workers=1, rollout=rollout)
            lines = (folder / "here.jsonl").read_bytes().splitlines(keepends=True)
            (folder / "part.jsonl").write_bytes(b"".join(lines[:4]))
            for name in ("there", "part"):
                file = folder / f"{name}.jsonl"
                there = dd.sweep(chosen, VARIATIONS, file, cluster=address, rollout=rollout)
                assert there.table() == here.table()
            assert there.table()["outcome"] == ["finished"] * 6 + ["no start"] * 2


@pytest.mark.slow
@pytest.mark.parametrize(
    "address", some(["", "nowhere", "127.0.0.1:1", "tcp://127.0.0.1:1", "x://y"], of=3)
)
def test_where_no_scheduler_answers_it_says_so(address, tmp_path, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr("drake_dae.studies.cluster.WAIT", 0.2)
    chosen = scenario("two_link_wall", "duration=0.5", "compiled=false")
    with pytest.raises(ModelError, match="Dask scheduler"):
        dd.sweep(chosen, [{}], tmp_path / "runs.jsonl", cluster=address)

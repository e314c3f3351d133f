"""Pages and live benches as a notebook shows them, without a notebook."""

import json
import re
from html import unescape
from urllib.error import URLError
from urllib.request import Request, urlopen

import numpy as np
import pytest
from test_bench_of_any_diagram import pendulum

from drake_dae import LiveBench, inline_page, replay, write_page


def asked(address, what, told):
    request = Request(f"{address}{what}", json.dumps(told).encode())
    with urlopen(request, timeout=20) as answer:
        return json.loads(answer.read())


def test_a_notebook_shows_a_bench_that_runs_beside_it():
    with LiveBench(pendulum(), title="pendulum") as bench:
        (address,) = re.findall(r'<iframe src="([^"]+)"', bench._repr_html_())
        assert address == bench.address
        with urlopen(address, timeout=20) as page:
            assert "<title>pendulum</title>" in page.read().decode()
        asked(address, "advance", {"ticks": 6, "set": [[4, -1.0]]})
        asked(address, "advance", {"ticks": 6, "set": []})
        record, commands = bench.record, bench.commands
        assert record.time.size == 13
        assert list(commands.commands) == [(0, "ConstantVectorSource.parameter[0]", -1.0)]
        assert "LiveBench" in asked(address, "save", None)["saved"]
    context = pendulum().CreateDefaultContext()
    np.testing.assert_array_equal(replay(pendulum(), context, commands)["state"], record["state"])
    with pytest.raises(URLError):
        urlopen(address, timeout=2)


@pytest.mark.slow
def test_a_notebook_shows_a_page_that_runs_in_it(tmp_path):
    pytest.importorskip("ziglang")
    page = inline_page(pendulum(), title="pendulum")
    (source,) = re.findall(r'<iframe srcdoc="([^"]*)"', page._repr_html_())
    assert unescape(source) == page
    (file,) = write_page(pendulum(), None, tmp_path / "pendulum.html", title="pendulum")
    assert file.read_text() == page

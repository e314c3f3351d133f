"""`drake-dae gallery` shows runs of scenarios on one page."""

import json
import re
import signal
import time

import pytest
from browser import low_contrast, needs_chromium
from command_line import command

from drake_dae.cli import main
from drake_dae.commands.gallery import CARD, TEMPLATE, Card
from drake_dae.scenario.shipped import shipped_scenarios


def write(path, *changes):
    """Writes two_link_wall with changes, and a run of 0.2 s; returns the path as text."""
    text = shipped_scenarios()["two_link_wall"].read_text("utf-8")
    for old, new in [("duration: 10.0", "duration: 0.2"), *changes]:
        assert old in text
        text = text.replace(old, new)
    path.write_text(text, "utf-8")
    return str(path)


MARKUP = ("description: Textbook two-link", "description: <b>bold</b> & two-link")


@pytest.mark.slow
def test_cards_show_runs_and_keep_markup_as_text(tmp_path, capsys):
    names = [write(tmp_path / "marked.yaml", MARKUP), "--out", str(tmp_path / "gallery")]
    assert main(["gallery", *names]) == 0
    assert "runs marked" in capsys.readouterr().out
    page = (tmp_path / "gallery" / "index.html").read_text("utf-8")
    assert "&lt;b&gt;bold&lt;/b&gt; &amp; two-link arm draws" in page
    assert "<b>bold" not in page
    # It can be steered where zig is installed, and says what is missing where not.
    assert ("bench.html" in page) != ("pip install" in page)
    assert re.search(r'<b class="(\w+)">\1</b>: \n(every|tool.z|the run)', page)
    assert re.search(r"off prediction by \d\.\de-1\d m, constraint residual \d\.\de-1\d", page)
    for file in re.findall(r'(?:href|src)="([^"]+)"', page):
        assert (tmp_path / "gallery" / file).is_file(), file
    # What has not changed does not run again.
    assert main(["gallery", *names]) == 0
    assert "runs marked" not in capsys.readouterr().out
    # What has changed does, and leaves no earlier run beside it.
    write(tmp_path / "marked.yaml", MARKUP, ("20 + 5 sin", "about 20"))
    assert main(["gallery", *names]) == 0
    assert "runs marked" in capsys.readouterr().out
    assert "about 20" in (tmp_path / "gallery" / "index.html").read_text("utf-8")
    assert [path.name for path in (tmp_path / "gallery").glob("marked*")] == ["marked"]


@pytest.mark.slow
def test_a_scenario_that_fails_leaves_the_others_and_says_why(tmp_path, capsys):
    files = [
        write(tmp_path / "bad.yaml", ("frame: tool\n  surface", "frame: hand\n  surface")),
        write(tmp_path / "good.yaml"),
    ]
    (tmp_path / "text.yaml").write_bytes(b"\xff\xfe")
    names = [*files, str(tmp_path / "text.yaml"), "--out", str(tmp_path / "gallery")]
    assert main(["gallery", *names]) == 1
    printed = capsys.readouterr().out
    assert "failed: bad, text; the same command tries them again" in printed
    page = (tmp_path / "gallery" / "index.html").read_text("utf-8")
    bad, good, text = re.findall(r"<article.*?</article>", page, re.DOTALL)
    assert "It fails: " in bad
    assert "&#x27;hand&#x27;" in bad
    assert "It fails: " in text
    assert "good/animation.html" in good
    # Once mended it runs, and the other one does not run again.
    write(tmp_path / "bad.yaml")
    assert main(["gallery", *files, *names[-2:]]) == 0
    assert re.findall(r"runs (\w+)", capsys.readouterr().out) == ["bad"]


@pytest.mark.slow
def test_an_interrupted_gallery_keeps_its_cards(tmp_path):
    slow = ("use_error_control: true", "target_realtime_rate: 0.02")
    files = [write(tmp_path / "a.yaml"), write(tmp_path / "b.yaml", slow)]
    out = tmp_path / "gallery"
    process = command("gallery", *files, "--out", out)
    while not (out / "b" / "record.part").exists() and process.poll() is None:
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 128 + signal.SIGINT, errors
    page = (out / "index.html").read_text("utf-8")
    assert re.findall(r'<article id="(\w+)">', page) == ["a"]
    assert json.loads((out / "a" / CARD).read_text("utf-8"))["state"]


def test_what_is_not_from_a_gallery_is_not_replaced(tmp_path, capsys):
    thesis, page = tmp_path / "two_link_wall" / "thesis.tex", tmp_path / "index.html"
    thesis.parent.mkdir()
    thesis.write_text("years", "utf-8")
    assert main(["gallery", "two_link_wall", "--out", str(tmp_path)]) == 1
    assert "two_link_wall' is not from a gallery; choose another" in capsys.readouterr().err
    page.write_text("<title>mine</title>", "utf-8")
    assert main(["gallery", "five_bar", "--out", str(tmp_path)]) == 1
    assert "index.html' is not from a gallery; choose another" in capsys.readouterr().err
    assert thesis.read_text("utf-8") == "years"
    assert page.read_text("utf-8") == "<title>mine</title>"


def test_names_that_share_a_folder_are_refused(tmp_path, capsys):
    file = write(tmp_path / "two_link_wall.yaml")
    assert main(["gallery", "two_link_wall", file, "--out", str(tmp_path / "gallery")]) == 1
    assert "two scenarios are named 'two_link_wall'" in capsys.readouterr().err
    assert not (tmp_path / "gallery").exists()


@needs_chromium
@pytest.mark.slow
def test_words_of_a_card_stand_out_from_light_and_dark(tmp_path):
    words = ("good", "bad", "undecided")
    cards = [Card("what it is", "source: 1", word, "why", "1 s", ["none"]) for word in words]
    text = TEMPLATE.read_text("utf-8").replace(
        "<!-- cards -->", "".join(card.to_html(card.outcome) for card in cards)
    )
    (tmp_path / "index.html").write_text(text, "utf-8")
    assert low_contrast(tmp_path / "index.html") == {}
    faded = text.replace(".bad {", ".bad { opacity: 1; } p {").replace("#b3261e", "#c99")
    (tmp_path / "faded.html").write_text(faded, "utf-8")
    assert "what it is" in low_contrast(tmp_path / "faded.html")

"""Progress bars: only for who can see them, and only for what lasts."""

import time

import pytest

from envmap_integrator.system import progress


@pytest.fixture
def forced(monkeypatch):
    """Bars at once, although stderr is captured."""
    monkeypatch.setenv("ENVMAP_PROGRESS", "1")
    monkeypatch.setattr(progress, "DELAY", 0.0)


def run_stages() -> None:
    with progress.stage("outer", total=2) as outer:
        with progress.stage("inner") as inner:
            time.sleep(0.2)
            inner(1)
        outer(2)


def test_nothing_is_shown_without_a_terminal(capsys):
    run_stages()
    assert capsys.readouterr() == ("", "")


def test_nested_stages_are_shown_on_stderr(capsys, forced):
    run_stages()
    out, err = capsys.readouterr()
    assert out == ""
    assert "outer" in err and "inner" in err


def test_a_short_stage_shows_no_bar(capsys, forced, monkeypatch):
    monkeypatch.setattr(progress, "DELAY", 60.0)
    run_stages()
    assert "outer" not in capsys.readouterr().err


def test_what_makes_the_user_wait_is_shown_soon(capsys, monkeypatch):
    monkeypatch.setenv("ENVMAP_PROGRESS", "1")
    with progress.stage("loading"):
        time.sleep(1)
    assert "loading" in capsys.readouterr().err


def test_the_time_that_is_left_is_told_where_it_is_known(capsys, forced):
    with progress.stage("solving"):
        time.sleep(0.2)
    assert "left:" not in capsys.readouterr().err
    with progress.stage("gathering", total=30) as advance:
        for _ in range(10):
            time.sleep(0.1)
            advance(1)
    assert "left: " in capsys.readouterr().err


def test_quiet(capsys, forced, monkeypatch):
    monkeypatch.setattr(progress, "quiet", True)
    run_stages()
    assert capsys.readouterr().err == ""


def test_an_error_in_a_stage_ends_its_bar(forced):
    with pytest.raises(ZeroDivisionError), progress.stage("failing"):
        raise ZeroDivisionError
    assert progress._display is None

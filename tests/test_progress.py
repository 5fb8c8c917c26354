"""Bars are shown where they were asked for, by a call or by the program around it, and nowhere else."""

from __future__ import annotations

import io
import sys
from concurrent.futures import ThreadPoolExecutor

import pytest

from jaxfilt.progress import everywhere, maker, rounds

tqdm = pytest.importorskip("tqdm.auto").tqdm


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_a_bar_is_shown_only_if_wanted(capsys):
    assert maker(False) is None
    assert rounds(3, "gradient", False) == range(3)
    assert list(rounds(3, "gradient", True)) == [0, 1, 2]
    assert "gradient: 100%" in capsys.readouterr().err


@pytest.mark.parametrize("stream", [Terminal, io.StringIO])
def test_a_program_shows_bars_of_all_its_calls_on_a_terminal(monkeypatch, stream):
    screen = stream()
    monkeypatch.setattr(sys, "stderr", screen)
    with everywhere(), ThreadPoolExecutor(1) as pool:
        assert list(rounds(3, "gradient", False)) == [0, 1, 2]
        assert pool.submit(list, rounds(2, "genetic", False)).result() == [0, 1]
    for name in ("gradient", "genetic"):
        assert (f"{name}:   0%" in screen.getvalue()) == (stream is Terminal)
    assert maker(False) is None


def test_without_tqdm_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "tqdm.auto", None)
    with pytest.raises(ImportError, match=r'pip install "jaxfilt\[progress\]"'):
        rounds(3, "gradient", True)

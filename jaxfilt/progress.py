"""Progress bars: asked for in one call, or by a program for all the calls that it makes."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import Any

_everywhere = False  # of the process: threads of a program are meant, too


def maker(progress: bool) -> Callable[..., Any] | None:
    """What makes a bar (tqdm's class, or its like), or None where none is wanted. Ask before the long work begins.

    Raises:
        ImportError: if one is wanted and tqdm is missing.
    """
    if not (progress or _everywhere):
        return None
    try:
        from tqdm.auto import tqdm
    except ImportError:
        raise ImportError('progress=True needs tqdm: pip install "jaxfilt[progress]"') from None
    return tqdm if progress else partial(tqdm, disable=None, leave=False)  # None: not in files and pipes


def rounds(total: int, method: str, progress: bool) -> Iterable[int]:
    """``range(total)``, with a bar if wanted."""
    make = maker(progress)
    return range(total) if make is None else make(range(total), desc=method)


@contextlib.contextmanager
def everywhere() -> Iterator[None]:
    """Inside it all long calls show a bar on a terminal, which goes when the call is done."""
    global _everywhere
    before, _everywhere = _everywhere, True
    try:
        yield
    finally:
        _everywhere = before

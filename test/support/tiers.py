"""Parameters by tier: the quick tier runs one or two cases of a law, ``-m slow`` the others."""

from collections.abc import Iterable

import pytest


def quick_only(cases: Iterable, *quick) -> list:
    """Return the cases as parameters; those that are not in ``quick`` are marked slow."""
    cases = list(cases)
    assert all(case in cases for case in quick)
    return [case if case in quick else slow(*(case if isinstance(case, tuple) else (case,)))
            for case in cases]


def slow(*values, id: str | None = None):    # noqa: A002 – as pytest.param has it
    """Return one case that is marked slow."""
    return pytest.param(*values, id=id, marks=pytest.mark.slow)

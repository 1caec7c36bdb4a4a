"""The errors that a user sees: one line, whatever was quoted, and the exit code that goes with it."""

from __future__ import annotations

import pickle

from hypothesis import given
from hypothesis import strategies as st

from calib.core.errors import BadInputError, CalibError, ReaderGoneError, UsageError


def test_exit_codes() -> None:
    assert (CalibError.exit_code, BadInputError.exit_code, UsageError.exit_code) == (3, 3, 2)
    assert ReaderGoneError("").exit_code == 141


@given(st.text())
def test_a_message_moves_no_cursor(text: str) -> None:
    shown = str(BadInputError(text))
    assert shown.isprintable()
    assert not text.isprintable() or shown == text


def test_what_was_quoted_stays_to_be_seen() -> None:
    assert str(BadInputError("a.csv: view \x1b[2J\n is é")) == r"a.csv: view \x1b[2J\n is é"


def test_an_error_goes_between_processes() -> None:
    error = pickle.loads(pickle.dumps(BadInputError("a\nb")))
    assert isinstance(error, BadInputError)
    assert str(error) == r"a\nb"

"""Whether a result can be trusted: the findings of its rules, and the worst of them as one word.

ok              nothing speaks against the result
poor            a result, but known too badly
inconsistent    the data contradict each other or what a person stated
unidentifiable  the data do not determine the result; its numbers mean nothing

Exit codes, the page, the header and the words in the terminal all follow from a `Verdict`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

Word = Literal["ok", "poor", "inconsistent", "unidentifiable"]
Severity = Literal["remark", "poor", "inconsistent", "unidentifiable"]

WORDS: tuple[Word, ...] = ("ok", "poor", "inconsistent", "unidentifiable")
"""From good to bad."""
POOR = WORDS[1:]

_RANK = {"remark": 0, "ok": 0, "poor": 1, "inconsistent": 2, "unidentifiable": 3}


@dataclass(frozen=True)
class Finding:
    """What one rule says of a result.

    Attributes
    ----------
    severity : a remark changes nothing, every other severity makes the verdict at least as bad.
    text : a sentence; empty where the finding is advice alone.
    advice : what to do about it; empty for nothing.
    """

    severity: Severity
    text: str
    advice: str = ""


@dataclass(frozen=True)
class Verdict:
    """The findings on a result, in the order in which the rules gave them."""

    findings: tuple[Finding, ...] = ()

    @staticmethod
    def of(findings: Iterable[Finding]) -> Verdict:
        """Gather the findings of several rules."""
        return Verdict(tuple(findings))

    @staticmethod
    def stored(
        word: Word, reasons: Sequence[str] = (), remarks: Sequence[str] = (), advice: Sequence[str] = ()
    ) -> Verdict:
        """The verdict whose word and sentences a file holds."""
        # In a file each list stands for itself, so every reason has the word of the whole.
        severity: Severity = "remark" if word == "ok" else word
        judged = [Finding(severity, text) for text in reasons]
        if word != "ok" and not judged:
            judged = [Finding(severity, "")]
        noted = [Finding("remark", text) for text in remarks]
        return Verdict((*judged, *noted, *(Finding("remark", "", text) for text in advice)))

    @property
    def word(self) -> Word:
        """The worst severity, "ok" where there are remarks alone."""
        return WORDS[max((_RANK[one.severity] for one in self.findings), default=0)]

    @property
    def ok(self) -> bool:
        """Whether nothing speaks against the result."""
        return self.word == "ok"

    @property
    def reasons(self) -> list[str]:
        """Sentences that explain a word other than ok, the worst first."""
        judged = [one for one in self.findings if one.severity != "remark" and one.text]
        return _unique(one.text for one in sorted(judged, key=lambda one: -_RANK[one.severity]))

    @property
    def remarks(self) -> list[str]:
        """Sentences that change nothing."""
        return _unique(one.text for one in self.findings if one.severity == "remark" and one.text)

    @property
    def advice(self) -> list[str]:
        """What to do, that of the worst findings first."""
        ranked = sorted(self.findings, key=lambda one: -_RANK[one.severity])
        return _unique(one.advice for one in ranked if one.advice)

    def __str__(self) -> str:
        """As the terminal shows it."""
        return "\n".join(LEADS.get(kind, "") + text for kind, text in self.lines)

    def __repr__(self) -> str:
        """The words of `str`: what a person sees who types a verdict's name."""
        return str(self)

    @property
    def lines(self) -> list[tuple[str, str]]:
        """Kind and text: the word, then the reasons, the remarks and the advice."""
        lists = {"reason": self.reasons, "remark": self.remarks, "advice": self.advice}
        said = [(kind, text) for kind, texts in lists.items() for text in texts]
        return [("verdict", f"verdict: {self.word}"), *said]


LEADS = {"reason": "  - ", "remark": "  (remark) ", "advice": "  next: "}
"""What stands before a sentence of each kind in a terminal."""


def worst(words: Iterable[str]) -> Word:
    """The worst of several words, "ok" for none."""
    return WORDS[max((_RANK[word] for word in words), default=0)]


def _unique(texts: Iterable[str]) -> list[str]:
    return list(dict.fromkeys(texts))

"""What a comparison states in words: verdicts on differences, oracle shares, headlines."""

from typing import Protocol, runtime_checkable

from asp_env.evaluation.statistics import is_resolved, samples_needed

RESOLVED = "resolved"
NOT_RESOLVED = "not resolved"


@runtime_checkable
class Statistic(Protocol):
    """A value with its interval, as in a row of `metrics.csv`."""

    @property
    def value(self) -> float | None: ...
    @property
    def low(self) -> float | None: ...
    @property
    def high(self) -> float | None: ...
    @property
    def n(self) -> float | None: ...
    @property
    def mde(self) -> float | None: ...


def verdict_text(difference: Statistic) -> str:
    """Whether a difference is resolved, or how many scenarios would be needed.

    Args:
        difference: a paired difference with its minimal detectable effect.

    Returns:
        `resolved`, `equal` if the methods never differ, or `not resolved` with the reason.
    """
    value, mde, n = difference.value, difference.mde, difference.n
    if value is None or mde is None or n is None:
        return f"{NOT_RESOLVED} (one recording)"
    if is_resolved(value, difference.low, difference.high, mde):
        return RESOLVED
    needed = samples_needed(value, mde, int(n))
    if needed is None:
        return "equal" if mde == 0.0 else f"{NOT_RESOLVED} (difference 0)"
    if needed <= n:
        return f"{NOT_RESOLVED} (0 in interval)"
    return f"{NOT_RESOLVED} (n ≈ {_two_digits(needed):,} needed)"


def share_text(share: Statistic) -> str:
    """An oracle share in percent with its interval, such as `40 % [25, 55]`.

    Args:
        share: an oracle share between 0 and 1.
    """
    if share.value is None:
        return ""
    text = f"{100 * share.value:.0f} %"
    if share.low is None or share.high is None:
        return text
    return f"{text} [{100 * share.low:.0f}, {100 * share.high:.0f}]"


def oracle_phrase(share: Statistic | None) -> tuple[str, str]:
    """An oracle share in words, such as `like a 40 % oracle`, and its interval, `[25, 55]`.

    Args:
        share: an oracle share between 0 and 1; without one, both texts are empty.
    """
    if share is None or share.value is None:
        return "", ""
    percent, _, bounds = share_text(share).partition(" % ")
    percent = percent.removesuffix(" %")
    article = "an" if percent.startswith("8") or percent in ("11", "18") else "a"
    return f"like {article} {percent} % oracle", bounds


def headline(
    name: str, reference: str, gain: str, difference: Statistic, share: Statistic | None
) -> str:
    """A sentence on a method: its oracle share, its difference to the reference, the verdict.

    Args:
        name: name of the method.
        reference: name of the reference.
        gain: the difference as text, such as `+0.026 [0.002, 0.051]`.
        difference: difference of the score to that of the reference.
        share: oracle share of the method; None where there is no ladder.
    """
    phrase, bounds = oracle_phrase(share)
    drives = f" drives {phrase} {bounds}".rstrip() if phrase else ""
    return f"{name}{drives}: score {gain} against {reference}, {verdict_text(difference)}."


def _two_digits(number: int) -> int:
    """A number rounded up to two significant digits."""
    unit = 10 ** max(len(str(number)) - 2, 0)
    return -(-number // unit) * unit

"""Win rates of a method in a study of pairs, with Wilson's interval."""

from __future__ import annotations

import math
from typing import NamedTuple

from lumisplat.config.checks import check_whole

_Z = 1.959963984540054
"""97.5 % quantile of the normal distribution: intervals cover 95 %."""


class WinRate(NamedTuple):
    """How often one of two methods was preferred, with a 95 % confidence interval; all 0..1."""

    rate: float
    """Wins over votes; NaN without votes."""
    low: float
    """Lower end of the interval."""
    high: float
    """Upper end of the interval."""


def win_rate(wins: int, votes: int) -> WinRate:
    """Returns the win rate of a method, with the 95 % interval of Wilson (1927) for a proportion.

    Votes count as independent. Votes of one rater, or about one pair, are alike: the true interval is then wider.

    Args:
        wins: Number of votes for the method, 0 to ``votes``.
        votes: Number of all votes, at least 0.

    Raises:
        ConfigError: A number is out of range.
    """
    check_whole("votes", votes, 0, 2**31)
    check_whole("wins", wins, 0, votes)
    if not votes:
        return WinRate(math.nan, 0.0, 1.0)
    share, spread = wins / votes, _Z * _Z / votes
    middle = (share + 0.5 * spread) / (1.0 + spread)
    half = math.sqrt(spread * (share * (1.0 - share) + 0.25 * spread)) / (1.0 + spread)
    return WinRate(share, max(middle - half, 0.0), min(middle + half, 1.0))

"""How likely chance alone is to make things agree."""

from math import lgamma, log, log1p

import numpy as np


def log10_at_least(least: int, tested: int, share: float) -> float:
    """Decimal logarithm of the probability that so many of those tested agree by chance.

    Parameters
    ----------
    least, tested : int
        At least `least` of `tested` agree; not more of them than there are.
    share : float
        Of those tested that agree by chance, in (0, 1), independently of each other.

    Returns
    -------
    log10_probability : float
        Of the binomial distribution's tail; exact where the probability itself is too small for
        a number.
    """
    if least <= 0:
        return 0.0
    choices = lgamma(tested + 1) - lgamma(least + 1) - lgamma(tested - least + 1)
    first = choices + least * log(share) + (tested - least) * log1p(-share)
    # each further term of the tail over the one before it
    k = np.arange(least, tested)
    growth = (tested - k) / (k + 1) * (share / (1.0 - share))
    return float(first / np.log(10.0) + np.log10(1.0 + np.cumprod(growth).sum()))

"""Numbers in sentences: shares, p-values, lists."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def percent(share: float) -> str:
    """Return a share as whole per cent: '35 %', never '-0 %'."""
    return f'{round(100.0 * share)} %'


def p_value_text(p_value: float, floor: float) -> str:
    """Return 'p = 0.012', or 'p < 0.0033' where it lies at the floor of what was drawn."""
    if np.isnan(p_value):
        return 'p unknown'
    return f'p < {floor:.2g}' if p_value <= floor * (1.0 + 1e-9) else f'p = {p_value:.2g}'


def listed(parts: Sequence[str]) -> str:
    """Join parts by commas and an `and`."""
    if len(parts) < 2:
        return ''.join(parts)
    return f'{", ".join(parts[:-1])} and {parts[-1]}'

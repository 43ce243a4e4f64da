"""What every test needs is there, or one line says how to get it, instead of an error a file."""

from __future__ import annotations

import importlib.util

import pytest

# Distribution -> module, of what package.xml cannot name: rosdep has no Debian package for these.
PIP_ONLY = {
    'EAIK': 'eaik',
    'arviz-stats': 'arviz_stats',
    'mcap': 'mcap',
    'msgspec': 'msgspec',
    'plotly': 'plotly',
    'rosbags': 'rosbags',
    'trimesh': 'trimesh',
}

_missing = [name for name, module in PIP_ONLY.items() if importlib.util.find_spec(module) is None]
if _missing:
    pytest.exit(
        f'error: the tests need {", ".join(_missing)}, which rosdep does not install: '
        f'pip install -c constraints-ros.txt {" ".join(_missing)}',
        returncode=2,
    )

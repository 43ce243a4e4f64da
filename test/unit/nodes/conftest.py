"""The robot bridge of most tests here; other nodes have a rig of their own."""

import pytest


@pytest.fixture
def rig(monkeypatch, tmp_path):
    """Return a function that makes a rig with these parameters."""
    from bridge_rig import Rig

    made = []

    def make(ready=True, **options):
        made.append(Rig(monkeypatch, tmp_path, **options))
        return made[-1].ready() if ready else made[-1]

    yield make
    for one in made:
        one.close()

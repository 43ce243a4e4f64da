"""Products of columns at joints from their angles agree with those of their displacements."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from discovery_scenes import residuals_of, session_with

from remaster_ros.calibration.noise import NoiseModel
from remaster_ros.discovery import screening
from remaster_ros.discovery.at_joints import AtJoints, suit
from remaster_ros.discovery.catalogue import Catalogue
from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.discovery.evidence import solve
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.screening import screen

NAMES = (
    'joint_compliance',
    'encoder_eccentricity',
    'gear_periodic',
    'joint_error_curve',
    'joint_coupling',
    'link_length',
    'step',
    'sensor_scale',
)


@cache
def scene() -> Residuals:
    return residuals_of(session_with(26, poses=20, sensor_count=2))


def catalogue_of(data: Residuals) -> Catalogue:
    return Catalogue.of(data, [c for name in NAMES for c in EFFECTS[name].cells(data.context)])


def with_directions(data: Residuals, split: tuple[int, ...]) -> Residuals:
    model = NoiseModel.of(data.rows, data.reference, split)
    return replace(data, noise_model=model, noise=model.noise(*noise_of(model)))


def noise_of(model: NoiseModel):
    """Parts that poses share, some much larger than those of single rows."""
    sigma = 1e-4 * np.linspace(1.0, 2.0, len(model.channels))
    return sigma, sigma[list(model.shares)] * np.linspace(0.5, 8.0, len(model.shares))


@pytest.mark.parametrize('split', [(), (0,)])
@pytest.mark.parametrize('given', [(), ('joint_compliance', 'joint_error_curve')])
def test_scores_are_those_of_the_displacements(split, given, monkeypatch):
    data = with_directions(scene(), split)
    catalogue = catalogue_of(data)
    cells = [[c for c in catalogue.cells if c.name == name][1] for name in given]
    fit = solve(data, cells)
    assert fit is not None
    fit = replace(fit, noise=data.noise)

    def screened():
        return screen(data, catalogue, fit, rng=np.random.default_rng(3), draws=40)

    quick = screened()
    with monkeypatch.context() as patch:
        patch.setattr(screening, 'suit', lambda *_: np.zeros(len(catalogue.cells), bool))
        slow = screened()
    suiting = suit(data, catalogue)
    # Most of the catalogue, gear errors above all; never free forms, nor what displaces.
    assert suiting.mean() > 0.5
    assert not np.any(suiting & (catalogue.penalised | (catalogue.joint < 0)))
    seen = np.isfinite(slow.score)
    assert np.array_equal(seen, np.isfinite(quick.score))
    assert quick.score[seen] == pytest.approx(slow.score[seen], rel=1e-3, abs=2e-3)
    assert quick.null == pytest.approx(slow.null, rel=1e-3, abs=2e-3)


def test_what_the_others_explain_is_left_to_the_columns_themselves():
    data = with_directions(scene(), ())
    catalogue = catalogue_of(data)
    rows = 3 * len(data)
    base = data.noise_model.whitened(data.base, data.noise).reshape(rows, -1)
    projected = np.linalg.qr(base)[0].astype(np.float32)
    observed = data.noise_model.whitened(data.errors, data.noise).reshape(rows, 1)
    products = AtJoints.of(data, catalogue, data.noise, observed.astype(np.float32), projected)
    # An error that all angles have in common is a zero-offset.
    places = [i for i, c in enumerate(catalogue.cells) if c.name == 'encoder_eccentricity']
    few = replace(catalogue, features=np.ones_like(catalogue.features))
    absorbed = replace(products, catalogue=few)
    batch = np.array([i for i in places if catalogue.joint[i] == 1 and catalogue.sizes[i] == 2])
    assert len(batch) > 0
    assert not np.any(absorbed.products(batch)[1])
    assert np.all(products.products(batch)[1])


def test_several_markers_of_one_frame_are_left_to_the_columns_themselves():
    data = scene()
    rows = replace(data.rows, frame=np.zeros(len(data), dtype=int))
    catalogue = catalogue_of(data)
    assert np.any(suit(data, catalogue))
    assert not np.any(suit(replace(data, rows=rows), catalogue))

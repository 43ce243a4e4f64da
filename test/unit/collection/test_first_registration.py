# SPDX-License-Identifier: Apache-2.0
"""Three points register a sensor; further ones refine it; those that do not agree tell so."""

import itertools

import numpy as np

from remaster_ros.collection.first_registration import FirstRegistration
from remaster_ros.collection.pairing import PairedReading
from remaster_ros.kinematics.transforms import apply, inverse, rotation_vector_to_matrix, transform
from remaster_ros.session.cells.workcell import read_cell

CHAIN = read_cell('demo').chain()
MARKERS = {'sir': np.array([0.1, 0.0, 0.0])}
T_R_N = transform(rotation_vector_to_matrix(np.array([0.3, -0.2, 2.5])), (1.9, 0.0, 1.3))
PLACES = np.random.default_rng(2).uniform(-0.6, 0.6, (5, len(CHAIN)))


def reading(q, shift=(0.0, 0.0, 0.0)):
    seen = apply(inverse(T_R_N), CHAIN.positions(q, MARKERS['sir'])) + np.asarray(shift)
    return PairedReading('mocap', 'sir', 1.0, q, seen, None, 1)


def begun():
    return FirstRegistration(CHAIN, MARKERS, ['mocap', 'tracker'], 0.025)


def test_the_third_point_registers_and_the_others_refine():
    registration = begun()
    assert [registration.add([reading(q)]) for q in PLACES] == [[], [], *[['mocap']] * 3]
    np.testing.assert_allclose(registration.T_R_N['mocap'], T_R_N, atol=1e-9)
    assert registration.describe() == 'mocap: point 5 of 3; tracker: point 0 of 3'


def test_what_was_measured_before_registers_at_once():
    registration = begun()
    assert registration.add([reading(q) for q in PLACES[:3]]) == ['mocap']


def test_points_that_do_not_agree_register_nothing_until_enough_do():
    registration = begun()
    for q, shift in zip(PLACES[:3], ((0, 0, 0), (0, 0, 0.15), (0, 0, 0))):
        assert registration.add([reading(q, shift)]) == []
    assert 'mocap' in registration.troubles
    assert registration.troubles['mocap'] in registration.describe()
    assert registration.add([reading(PLACES[3])]) == ['mocap']
    assert not registration.troubles
    np.testing.assert_allclose(registration.T_R_N['mocap'], T_R_N, atol=1e-6)


def test_which_reflector_a_search_has_found_is_told_by_how_the_points_agree():
    both = {'smr': MARKERS['sir'], 'smr_2': np.array([0.0, -0.09, 0.03])}
    for found in itertools.product(both, repeat=3):
        registration = FirstRegistration(CHAIN, both, ['tracker'], 0.025, {'tracker': tuple(both)})
        for q, name in zip(PLACES, found):
            # The arm's own error: some millimetres, as before a calibration.
            seen = apply(inverse(T_R_N), CHAIN.positions(q + 3e-3, both[name]))
            done = registration.add([PairedReading('tracker', 'smr', 1.0, q, seen)])
        assert done == ['tracker'], (found, registration.troubles)
        np.testing.assert_allclose(registration.T_R_N['tracker'], T_R_N, atol=0.02)


def test_reflectors_that_cannot_be_told_apart_register_nothing():
    """On one circle about joint 1, which alone moves: either fits, with the tracker turned."""
    T_R_T, turn = CHAIN.forward(PLACES[0]), rotation_vector_to_matrix(np.array([0.0, 0.0, 0.3]))
    other = apply(inverse(T_R_T), turn @ apply(T_R_T, MARKERS['sir']))
    both = {'smr': MARKERS['sir'], 'smr_2': other}
    registration = FirstRegistration(CHAIN, both, ['tracker'], 0.025, {'tracker': tuple(both)})

    def add(q):
        seen = apply(inverse(T_R_N), CHAIN.positions(q, both['smr']))
        return registration.add([PairedReading('tracker', 'smr', 1.0, q, seen)])

    turns = [PLACES[0] + np.eye(len(CHAIN))[0] * angle for angle in (0.0, 0.4, 0.8)]
    assert [add(q) for q in turns] == [[], [], []]
    assert 'cannot be told apart' in registration.troubles['tracker']
    # A pose of another kind tells.
    assert add(PLACES[1]) == ['tracker']
    np.testing.assert_allclose(registration.T_R_N['tracker'], T_R_N, atol=1e-9)


def test_the_markers_of_one_frame_are_one_place():
    """Three points of a tool lie too close together to register a sensor by."""
    body = {'sir': MARKERS['sir'], 'b': np.array([0.0, 0.09, 0.0]), 'c': np.zeros(3)}
    registration = FirstRegistration(CHAIN, body, ['mocap'], 0.025)

    def frame(q):
        seen = {name: apply(inverse(T_R_N), CHAIN.positions(q, at)) for name, at in body.items()}
        return [PairedReading('mocap', name, 1.0, q, at, None, 1) for name, at in seen.items()]

    assert [registration.add(frame(q)) for q in PLACES[:3]] == [[], [], ['mocap']]
    np.testing.assert_allclose(registration.T_R_N['mocap'], T_R_N, atol=1e-9)
    assert registration.describe() == 'mocap: point 3 of 3'

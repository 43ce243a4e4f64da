# SPDX-License-Identifier: Apache-2.0
"""What a terminal says of a joint that the data do not determine: one line, with the remedy."""

import pytest

from remaster_ros.calibration.gauge_words import in_a_line


@pytest.mark.parametrize(
    ('why', 'line'),
    [
        (
            'joint_1 offset = a rotation of the mocap and tracker registrations about the base '
            'axis; a known base frame (base_prior) would separate them; fixed by joint_1 = 0',
            'looks like a rotation of the mocap and tracker registrations about the base axis; a '
            'known base frame (base_prior) would separate them',
        ),
        (
            'joint_7 offset = the marker ma moved tangentially, 1.74 mm per degree, the marker mb '
            'moved tangentially, 1.6 mm per degree, the marker mc moved tangentially, 1.3 mm per '
            'degree and the marker md moved tangentially, 1.275 mm per degree; a measured marker '
            'would separate them; fixed by the prior on marker ma, 0.5 mm per axis',
            'looks like the marker ma moved, the marker mb moved and 2 more; a measured marker '
            'would separate them',
        ),
        (
            'joint_2 (+1), joint_3 (-0.42), x of m (+1e-05) and y of m (+3) together change no '
            'observation; poses that are spread further and turn the tool, or a prior on one of '
            'them, would separate them',
            'joint_2, joint_3 and 2 more; poses that are spread further and turn the tool, or a '
            'prior on one of them, would separate them',
        ),
        (
            'joint_7 moves no marker; a marker off its axis would show it',
            'joint_7 moves no marker; a marker off its axis would show it',
        ),
    ],
)
def test_causes_and_remedy_stay_and_amounts_go(why, line):
    assert in_a_line(why) == line

# SPDX-License-Identifier: Apache-2.0
"""NatNet frames with damaged bytes, from the wire to the mean that is recorded.

NatNet has no checksum. Some damaged frames pass all that is asked of a single one; no mean of a
dwell is off by more than a frame of its own noise.
"""

import random

import numpy as np
import pytest

from remaster_ros.collection.pairing import PairedReading, Pairing, SensorRules
from remaster_ros.sensors.optitrack import natnet, natnet_bytes
from remaster_ros.sensors.optitrack.frame_gate import GateCounts, MarkerChoice, MarkerGate
from remaster_ros.sensors.optitrack.natnet_frame import Frame, LabeledMarker
from remaster_ros.types import MarkerReading

VERSION, MARKER, TICKS_PER_S = (3, 1), 1 << 16 | 1, 10_000_000
TRUE = np.array([0.3, -0.2, 2.5])
SIGMA = np.array([0.03e-3, 0.03e-3, 0.1e-3])
STANDS = np.zeros(7)
MOST_OFF_M = 2.0 * SIGMA.max()


def damaged(rng, datagram):
    """Return a datagram with a bit, a byte or four bytes changed, anywhere."""
    data, at = bytearray(datagram), rng.randrange(len(datagram))
    match rng.choice(('bit', 'byte', 'word')):
        case 'bit':
            data[at] ^= 1 << rng.randrange(8)
        case 'byte':
            data[at] = rng.randrange(256)
        case 'word':
            data[at : at + 4] = rng.randbytes(min(4, len(data) - at))
    return bytes(data)


class Bar:
    """A stream of a marker that stands, of whose frames a share is damaged on its way."""

    def __init__(self, seed, share, rate):
        print(f'seed {seed}')
        self.noise, self.rng = np.random.default_rng(seed), random.Random(seed)
        self.share, self.rate = share, rate
        self.gate = MarkerGate(MarkerChoice(marker_id=MARKER), GateCounts())
        self.time_s, self.number, self.samples = 1.0, 0, []

    def frame(self):
        """Return where the marker was measured, and what is let through of that frame."""
        self.time_s += 1.0 / self.rate
        self.number += 1
        position = TRUE + SIGMA * self.noise.standard_normal(3)
        marker = LabeledMarker(MARKER, tuple(position), 0.01, 0x0A, 1e-4)
        data = natnet.encode_message(Frame(self.number, self.time_s, (marker,)), VERSION)
        if self.rng.random() < self.share:
            data = damaged(self.rng, data)
        try:
            message = natnet.decode_message(data, VERSION)
        except natnet_bytes.ProtocolError:
            return position, None
        if not isinstance(message, Frame):
            return position, None
        return position, self.gate.admit(message, self.time_s, TICKS_PER_S)

    def reading(self, dwell_s):
        """Return the mean of a dwell and that of its frames as they were sent."""
        pairing = Pairing(self.time_s, STANDS, (SensorRules('mocap', 'sir', dwell_s=dwell_s),))
        end_s, sent = self.time_s + dwell_s, []
        while self.time_s < end_s + 3.0 / self.rate:
            position, sample = self.frame()
            sent += [position] if self.time_s <= end_s else []
            if sample is not None:
                self.samples.append(sample.position)
                pairing.add_reading('mocap', MarkerReading(sample.timestamp_s, sample.position))
            pairing.add_joint_state(self.time_s, STANDS)
        pairing.add_joint_state(self.time_s + 0.1, STANDS)
        pairing.give_up(self.time_s + 10.0)
        return pairing.decided['mocap'], np.mean(sent, axis=0)


@pytest.mark.parametrize(('rate', 'dwell_s'), [(100.0, 0.5), (30.0, 0.5), (30.0, 0.2)])
@pytest.mark.parametrize('share', [0.02, 0.1, 0.3])
def test_no_mean_is_off_by_what_a_damaged_frame_may_be(share, rate, dwell_s):
    bar, off, rejected_count = Bar(1, share, rate), [], 0
    # As many frames of each.
    for _ in range(round(1500 / (rate * dwell_s))):
        found, sent = bar.reading(dwell_s)
        if isinstance(found, PairedReading):
            off.append(np.linalg.norm(found.position - sent))
        else:
            rejected_count += 1
    assert len(off) > 0.9 * (len(off) + rejected_count)
    assert max(off) < MOST_OFF_M
    if share > 0.02:
        # There were such frames.
        wrong = np.linalg.norm(np.array(bar.samples) - TRUE, axis=1)
        assert wrong.max() > 10 * MOST_OFF_M


def test_stamps_in_no_order_end_no_recorder():
    """A damaged stamp looks like a stream that was started again."""
    rules = SensorRules('mocap', 'sir', dwell_s=0.2)
    for late in range(8):
        pairing = Pairing(10.0, STANDS, (rules,))
        stamps = [10.01 + 0.3 * i for i in range(8)]
        stamps[late], stamps[-1 - late] = stamps[-1 - late], stamps[late]
        for stamp_s in stamps:
            pairing.add_reading('mocap', MarkerReading(stamp_s, TRUE + 1e-5 * stamp_s))
            pairing.add_joint_state(stamp_s + 0.01, STANDS)
        pairing.add_joint_state(13.0, STANDS)
        pairing.give_up(30.0)
        assert 'mocap' in pairing.decided

# SPDX-License-Identifier: Apache-2.0
"""A fake OptiTrack server and a client of it, on real sockets."""

from __future__ import annotations

import contextlib

import numpy as np
from worlds.optitrack_world import SENSOR, MarkerWorld, eventually, free_port

from remaster_ros.errors import DeviceError
from remaster_ros.sensors.optitrack.client import NatNetClient
from remaster_ros.sensors.optitrack.settings import NatNetSettings
from remaster_ros.simulation.optitrack import FakeOptiTrackServer
from remaster_ros.simulation.optitrack_scene import OptiTrackBehaviour

LOCAL = '127.0.0.1'
NOISELESS = OptiTrackBehaviour(noise_across_m=0.0, noise_along_m=0.0)


@contextlib.contextmanager
def fake_server(data_port, command_port=0, world=None, **options):
    server = FakeOptiTrackServer(
        world or MarkerWorld(),
        SENSOR,
        np.random.default_rng(1),
        command_port=command_port,
        data_port=data_port,
        **options,
    )
    with server:
        yield server


def wait_for_the_marker(client, within_s=20.0):
    """Wait for the first believed frame and the marker's identity; else raise the diagnosis."""

    def is_there():
        status = client.status()
        return status.silent_s is not None and not status.problem

    if not eventually(is_there, within_s):
        raise DeviceError(client.diagnosis().message)


@contextlib.contextmanager
def client_of(port, data_port, on_sample=lambda sample: None, wait_s=20.0, clock=None, **settings):
    client = NatNetClient(
        NatNetSettings(
            **({'command_port': port, 'data_port': data_port, 'silence_s': 0.4} | settings)
        ),
        on_sample,
        *([clock] if clock else []),
    )
    client.start()
    try:
        if wait_s:
            wait_for_the_marker(client, wait_s)
        yield client
    finally:
        client.stop()


@contextlib.contextmanager
def followed(on_sample=lambda sample: None, server=None, **settings):
    """Run a fake server with these options, and a client of it with these settings."""
    port = free_port()
    with (
        fake_server(port, **(server or {})) as fake,
        client_of(fake.command_port, port, on_sample, **settings) as client,
    ):
        yield fake, client

# SPDX-License-Identifier: Apache-2.0
"""Noise of each sensor in the result of a fit: means and standard deviations over the draws.

Noise of orientations has the same form, under the names of `Posterior.noise_names`, in rad.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from remaster_ros.calibration.noise import Noise
from remaster_ros.calibration.posterior import Posterior
from remaster_ros.types import FloatArray


@dataclass(frozen=True)
class NoiseEstimate:
    """Noise of one sensor per axis, m: posterior means, and the standard deviation of ``sigma_m``.

    ``pose_sigma_m`` is None if no pose has two frames: ``sigma_m`` then holds both parts, or
    ``frame_sigma_m`` does, the noise common to the markers of a frame; it is None if no frame has
    two markers. If the noise along the line of sight differs, these are root mean squares over the
    three axes, and ``directions`` has the noise 'along' and 'across'; otherwise it is empty.
    """

    sigma_m: float
    std_m: float
    pose_sigma_m: float | None
    pose_std_m: float | None
    frame_sigma_m: float | None = None
    frame_std_m: float | None = None
    directions: Mapping[str, NoiseEstimate] = field(default_factory=dict)


def noise_estimates(posterior: Posterior, by_channel: Noise) -> dict[str, NoiseEstimate]:
    """Noise of every sensor from draws of the channels' noise (chains, draws, …)."""
    noise_model = posterior.noise_model
    by_sensor = noise_model.sensor_noise(by_channel)
    separate = {noise_model.channels[index].sensor for index in noise_model.separable}
    framed = {noise_model.channels[index].sensor for index in noise_model.framed}

    def of_draws(draws: FloatArray, known: bool) -> tuple[float, float] | tuple[None, None]:
        return (float(draws.mean()), float(draws.std(ddof=1))) if known else (None, None)

    def estimate(noise: Noise, at: int, sensor: int) -> NoiseEstimate:
        sigma = noise.sigma[..., at]
        return NoiseEstimate(
            float(sigma.mean()),
            float(sigma.std(ddof=1)),
            *of_draws(noise.pose_sigma[..., at], sensor in separate),
            *of_draws(noise.frame_sigma[..., at], sensor in framed),
        )

    result = {}
    for sensor, name in enumerate(posterior.noise_names):
        directions = {
            channel.direction: estimate(by_channel, index, sensor)
            for index, channel in enumerate(noise_model.channels)
            if channel.sensor == sensor and channel.direction
        }
        result[name] = replace(estimate(by_sensor, sensor, sensor), directions=directions)
    return result

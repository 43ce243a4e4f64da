# SPDX-License-Identifier: Apache-2.0
"""Noise of each sensor in the result of a fit: means and standard deviations over the draws.

Noise of orientations has the same form, under the names of `Posterior.noise_names`, in rad.
"""

from __future__ import annotations

from collections.abc import Mapping

from msgspec import UNSET, Struct, UnsetType
from msgspec.structs import replace

from remaster_ros.calibration.noise import Noise
from remaster_ros.calibration.posterior import Posterior
from remaster_ros.types import FloatArray


class NoiseEstimate(Struct, frozen=True):
    """Noise of one sensor per axis, m: posterior means, and the standard deviation of ``sigma_m``.

    ``pose_sigma_m`` is None if no pose has two frames: ``sigma_m`` then holds both parts, or
    ``frame_sigma_m`` does, the noise common to the markers of a frame; it is unset if no frame has
    two markers. If the noise along the line of sight differs, these are root mean squares over the
    three axes, and that along and across it is given as well.
    """

    sigma_m: float
    std_m: float
    pose_sigma_m: float | None
    pose_std_m: float | UnsetType | None = UNSET
    frame_sigma_m: float | UnsetType = UNSET
    frame_std_m: float | UnsetType = UNSET
    along_sigma_m: float | UnsetType = UNSET
    along_std_m: float | UnsetType = UNSET
    along_pose_sigma_m: float | UnsetType | None = UNSET
    along_pose_std_m: float | UnsetType | None = UNSET
    along_frame_sigma_m: float | UnsetType = UNSET
    along_frame_std_m: float | UnsetType = UNSET
    across_sigma_m: float | UnsetType = UNSET
    across_std_m: float | UnsetType = UNSET
    across_pose_sigma_m: float | UnsetType | None = UNSET
    across_pose_std_m: float | UnsetType | None = UNSET
    across_frame_sigma_m: float | UnsetType = UNSET
    across_frame_std_m: float | UnsetType = UNSET

    @property
    def directions(self) -> Mapping[str, NoiseEstimate]:
        """Noise 'along' and 'across' the line of sight; {} if they do not differ."""
        if self.along_sigma_m is UNSET:
            return {}
        return {
            direction: NoiseEstimate(*(getattr(self, f'{direction}_{key}') for key in KEYS))
            for direction in ('along', 'across')
        }


KEYS = NoiseEstimate.__struct_fields__[:6]


def noise_estimates(posterior: Posterior, by_channel: Noise) -> dict[str, NoiseEstimate]:
    """Noise of every sensor by name, then of orientations, from draws of the channels' noise.

    ``by_channel``: (chains, draws, channels). Means and standard deviations over all draws; a part
    that a sensor's noise does not have is None (pose_sigma) or UNSET (frame_sigma).
    """
    noise_model = posterior.noise_model
    by_sensor = noise_model.sensor_noise(by_channel)
    separate = {noise_model.channels[index].sensor for index in noise_model.separable}
    framed = {noise_model.channels[index].sensor for index in noise_model.framed}

    def of_draws(draws: FloatArray) -> tuple[float, float]:
        return float(draws.mean()), float(draws.std(ddof=1))

    def estimate(noise: Noise, at: int, sensor: int) -> NoiseEstimate:
        pose, frame = noise.pose_sigma[..., at], noise.frame_sigma[..., at]
        return NoiseEstimate(
            *of_draws(noise.sigma[..., at]),
            *(of_draws(pose) if sensor in separate else (None, None)),
            *(of_draws(frame) if sensor in framed else (UNSET, UNSET)),
        )

    result = {}
    for sensor, name in enumerate(posterior.noise_names):
        directions = {
            f'{channel.direction}_{key}': getattr(estimate(by_channel, index, sensor), key)
            for index, channel in enumerate(noise_model.channels)
            if channel.sensor == sensor and channel.direction
            for key in KEYS
        }
        result[name] = replace(estimate(by_sensor, sensor, sensor), **directions)
    return result

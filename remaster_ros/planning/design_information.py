# SPDX-License-Identifier: Apache-2.0
"""What configurations will tell of the joint offsets: Fisher information before any measurement.

Model, derivatives, priors and gauge are those of the fit (`calibration`), at the nominal arm: the
standard deviations expected here are those that the fit will state at the noise that is expected.

All markers that one sensor sees at one configuration come from one frame. The error of a marker is
a sum of three Gaussians per axis: its own (sigma), one that the frame shares (frame_sigma) and
one that all frames of that sensor at one pose share (pose_sigma). With M markers of a frame, the
mean J of their derivatives and v = sigma²/M + frame_sigma², the information of m configurations of
a pose is, by the Sherman-Morrison formula::

    sum of own  -  pose_sigma² / (1 + m pose_sigma² / v)  (sum of J/v)' (sum of J/v)

where own = J'J/v + (deviations of the markers' derivatives from J, squared) / sigma².
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import block_diag

from remaster_ros.calibration.identifiability import find_gauge
from remaster_ros.calibration.model import Model
from remaster_ros.calibration.priors import prior_rows
from remaster_ros.discovery.effects.context import Context
from remaster_ros.errors import InputError
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.planning.candidates import PlannedPose
from remaster_ros.planning.expected_sensors import (
    ExpectedSensor,
    ToolBox,
    expected_measurements,
    expected_priors,
    expected_rows,
    nominal_model,
)
from remaster_ros.types import FloatArray, IntArray, Measurements, Priors

UNKNOWN = 1e-8
"""Share of the mean information of a configuration that stands for "nothing known": it keeps the
first choices finite, and changes no standard deviation once the parameters are determined."""


@dataclass(frozen=True, eq=False)
class FurtherColumns:
    """Parameters beyond those of the offsets model: of causes that are to be distinguished."""

    names: tuple[str, ...]  # m of them
    # Of a context: displacement of the marker in R, m per unit, (n, 3, m)
    displacement: Callable[[Context], FloatArray]
    std: FloatArray  # Standard deviation of the prior on each about 0, (m,)


@dataclass(frozen=True, eq=False)
class DesignInformation:
    """Information of n configurations on the f free parameters, which have unit information.

    The parameters are divided by `scale`, so that all are of one size.
    """

    joint_names: tuple[str, ...]  # Of the k joints
    q: FloatArray  # The configurations, rad, (n, k)
    pose: IntArray  # Which pose each belongs to, (n,)
    # Information of each configuration, but for the error that its pose shares, (n, f, f)
    own: FloatArray
    # Mean derivative over the markers of each frame, over its variance, (n, sensors, 3, f)
    weighted: FloatArray
    weight: FloatArray  # 1/v of a frame, m^-2, (sensors,)
    pose_variance: FloatArray  # pose_sigma², m², (sensors,)
    prior: FloatArray  # Information of the priors, (f, f)
    # Mean of J'J over the markers and the configurations in the box, m² per unit, (f, f)
    tool: FloatArray
    scale: FloatArray  # (f,)
    identifiable: Mapping[int, int]  # Joint -> its index among the free parameters
    names: tuple[str, ...]  # Of the free parameters, as the fit has them
    per_radian: FloatArray  # What of each joint's unit counts as a radian, (k,)

    @classmethod
    def of(
        cls,
        chain: SerialChain,
        poses: Sequence[PlannedPose],
        sensors: Sequence[ExpectedSensor],
        marker_std_m: float,
        priors: Priors | None = None,
        box: ToolBox | None = None,
        further: FurtherColumns | None = None,
    ) -> DesignInformation:
        """Differentiate the model at the nominal arm.

        ``chain``: the nominal arm; ``poses``: poses that can be measured, each with the solutions
        that can be; ``sensors``: what measures them; a marker that two sensors follow has one
        position; ``marker_std_m``: how well the markers' positions are known, per axis, m;
        ``priors``: what is known of offsets and registrations beforehand; ``box``: where the tool
        is to be accurate; None for wherever these poses are; ``further``: parameters beyond those
        of the offsets model; behind the others.
        Raises InputError: no configuration, or none with the tool in the box;
        InsufficientDataError: all these configurations together do not determine the parameters.
        """
        q = np.concatenate([np.empty((0, len(chain))), *(pose.solutions for pose in poses)])
        if not len(q):
            raise InputError('there is no configuration to choose from')
        pose = np.repeat(np.arange(len(poses)), [len(one.solutions) for one in poses])
        priors = priors or Priors()
        model, x = nominal_model(chain, q, sensors, priors)
        known = expected_priors(model, x, marker_std_m, priors)
        measurements = expected_measurements(model, q, pose, sensors)
        rows = expected_rows(model, x, measurements, sensors)
        held = find_gauge(model, x, rows, known)
        free = np.setdiff1d(np.arange(model.size), held.held)
        derivative = model.natural_jacobian(x, rows)[:, :, free]
        by_x = prior_rows(model, known, x, natural=True)[1][:, free]
        names = [model.names[index] for index in free]
        if further is not None:
            context = nominal_context(model, x, measurements)
            more = further.displacement(context)[rows.source]
            derivative = np.concatenate((derivative, more), axis=2)
            by_x = block_diag(by_x, np.diag(1.0 / further.std))
            names += further.names

        size = len(names)
        own = np.zeros((len(q), size, size))
        weighted = np.zeros((len(q), len(sensors), 3, size))
        weight = np.zeros(len(sensors))
        for index, span in rows.spans:
            sensor = sensors[index]
            count = len(sensor.markers)
            # In the order of the configurations, the markers of a frame next to each other.
            mine = derivative[span][np.argsort(rows.source[span])]
            mine = mine.reshape(len(q), count, 3, -1)
            mean = mine.mean(axis=1)
            apart = (mine - mean[:, None]).reshape(len(q), 3 * count, -1)
            weight[index] = 1.0 / (sensor.sigma_m**2 / count + sensor.frame_sigma_m**2)
            own += _squares(apart) / sensor.sigma_m**2 + _squares(mean) * weight[index]
            weighted[:, index] = mean * weight[index]
        inside = np.ones(len(q), bool)
        if box is not None:
            inside = box.holds(chain.positions(q, np.zeros(3)))
            if not inside.any():
                raise InputError(
                    'no configuration has the tool in poses.tool_box, '
                    f'{np.round(box.size_m, 3)} m about {np.round(box.center_m, 3)} m; move or '
                    'enlarge it'
                )
        seen = derivative[inside[measurements.configuration[rows.source]]]
        prior = by_x.T @ by_x
        scale = 1.0 / np.sqrt(np.diag(own.mean(axis=0) + prior))
        both = np.outer(scale, scale)
        return cls(
            chain.joint_names,
            q,
            pose,
            own * both,
            weighted * scale,
            weight,
            np.array([sensor.pose_sigma_m**2 for sensor in sensors]),
            prior * both,
            np.einsum('nij,nik->jk', seen, seen) / len(seen) * both,
            scale,
            {
                joint: int(np.searchsorted(free, joint))
                for joint in range(len(chain))
                if not held.why[joint]
            },
            tuple(names),
            chain.per_radian,
        )

    def __len__(self) -> int:
        """Return the number of configurations."""
        return len(self.q)

    def only(self, kept: IntArray) -> DesignInformation:
        """Return it with only these configurations, in this order."""
        return replace(
            self,
            q=self.q[kept],
            pose=self.pose[kept],
            own=self.own[kept],
            weighted=self.weighted[kept],
        )

    def whole_poses(self) -> tuple[DesignInformation, list[IntArray]]:
        """Return it for poses in all their configurations, and which these are.

        Poses share nothing, so that their information adds up.
        """
        members = [np.flatnonzero(self.pose == index) for index in np.unique(self.pose)]
        sums = np.array([self.weighted[mine].sum(axis=0) for mine in members])
        shared = self._shared(sums, np.array([len(mine) for mine in members]))
        own = np.array([self.own[mine].sum(axis=0) for mine in members]) - shared
        first = [mine[0] for mine in members]
        poses = replace(
            self,
            q=self.q[first],
            pose=np.arange(len(members)),
            own=own,
            weighted=np.zeros((len(members), *self.weighted.shape[1:])),
        )
        return poses, members

    def total(self, chosen: Sequence[int]) -> FloatArray:
        """Return the information of chosen configurations and the priors, (f, f)."""
        which = np.array(chosen, dtype=np.int64)
        sums, count = self._sums(chosen)
        visited = np.flatnonzero(count)
        shared: FloatArray = self._shared(sums[visited], count[visited]).sum(axis=0)
        return self.prior + self.own[which].sum(axis=0) - shared

    def with_each(self, chosen: Sequence[int], among: IntArray) -> FloatArray:
        """Return the information of the chosen with each of some others, (m, f, f).

        That of a configuration that is among the chosen has no meaning.
        """
        sums, count = self._sums(chosen)
        pose = self.pose[among]
        before = self._shared(sums, count)[pose]
        after = self._shared(sums[pose] + self.weighted[among], count[pose] + 1)
        return self.total(chosen) + self.own[among] - after + before

    def gains(self, chosen: Sequence[int], root: FloatArray) -> FloatArray:
        """Return trace(K' dM K) of the information dM that each configuration adds, (n,).

        With K (f, r) = M^-1 L this is by how much it lowers trace(L' M^-1 L), to first order.
        """
        sums, count = self._sums(chosen)
        of_sums, of_each = sums @ root, self.weighted @ root
        factor = self._factor(count)
        before = np.einsum('ps,psir,psir->p', factor, of_sums, of_sums)[self.pose]
        after = of_sums[self.pose] + of_each
        shared = np.einsum('ns,nsir,nsir->n', self._factor(count + 1)[self.pose], after, after)
        own = self.own.reshape(len(self), -1) @ (root @ root.T).ravel()
        result: FloatArray = own - shared + before
        return result

    def _sums(self, chosen: Sequence[int]) -> tuple[FloatArray, IntArray]:
        """Return the sum of J/v of each pose's chosen, (poses, s, 3, f), and their number."""
        which = np.array(chosen, dtype=np.int64)
        sums = np.zeros((int(self.pose.max()) + 1, *self.weighted.shape[1:]))
        np.add.at(sums, self.pose[which], self.weighted[which])
        return sums, np.bincount(self.pose[which], minlength=len(sums))

    def _factor(self, count: IntArray) -> FloatArray:
        """Return what (sum of J/v)' (sum of J/v) is multiplied by, (p, s), of m frames (p,)."""
        return self.pose_variance / (1.0 + count[:, None] * self.pose_variance * self.weight)

    def _shared(self, sums: FloatArray, count: IntArray) -> FloatArray:
        """Return what the error that a pose shares takes away: (p, f, f) of sums (p, s, 3, f)."""
        rooted = np.sqrt(self._factor(count))[:, :, None, None] * sums
        return _squares(rooted.reshape(len(sums), 3 * len(self.weight), len(self.scale)))

    def covariance(self, chosen: Sequence[int]) -> FloatArray:
        """Return the expected covariance of the free parameters, rad and m, (f, f)."""
        return np.linalg.inv(self.finite(self.total(chosen))) * np.outer(self.scale, self.scale)

    def finite(self, information: FloatArray) -> FloatArray:
        """Return information (..., f, f) that can be inverted where nothing is known yet."""
        return information + UNKNOWN * np.eye(len(self.scale))

    def joint_std(self, chosen: Sequence[int]) -> dict[str, float | None]:
        """Return each joint's expected standard deviation, rad or m; None if not identifiable."""
        variance = np.diag(self.covariance(chosen))
        return {
            name: float(np.sqrt(variance[self.identifiable[joint]]))
            if joint in self.identifiable
            else None
            for joint, name in enumerate(self.joint_names)
        }

    def joint_rms(self, chosen: Sequence[int]) -> float:
        """Return the root mean square of the identifiable joints' standard deviations, rad.

        That of a joint that slides is divided by `SerialChain.per_radian`.
        """
        std = [
            value / unit
            for value, unit in zip(self.joint_std(chosen).values(), self.per_radian)
            if value is not None
        ]
        return float(np.sqrt(np.mean(np.square(std))))

    def tool_rms(self, chosen: Sequence[int]) -> float:
        """Return the root mean square of the 3-D error of the predicted markers in the box, m."""
        covariance = np.linalg.inv(self.finite(self.total(chosen)))
        return float(np.sqrt(np.sum(covariance * self.tool)))


def nominal_context(model: Model, x: FloatArray, measurements: Measurements) -> Context:
    """Return what effects depend on at the nominal arm; nothing is known of times and ways."""
    return Context(
        model.chain,
        measurements,
        model.sensor_names,
        model.marker_names,
        np.zeros(model.joints),
        model.markers(x),
        model.reference,
        timed=False,
    )


def _squares(values: FloatArray) -> FloatArray:
    """Return J'J of each J (..., rows, f), (..., f, f)."""
    return np.swapaxes(values, -1, -2) @ values

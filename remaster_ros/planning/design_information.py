# SPDX-License-Identifier: Apache-2.0
"""Fisher information of configurations on the joint offsets, before any measurement.

Model, derivatives, priors and gauge are those of the fit (`calibration`), at the nominal arm: the
standard deviations expected here are those that the fit will state at the expected noise.

All markers that one sensor sees at one configuration come from one frame. The error of a marker is
a sum of three Gaussians per axis: of the marker (sigma), of the frame, common to its markers
(frame_sigma), and of the pose, common to all frames of that sensor at the pose (pose_sigma). With
M markers of a frame, the mean J of their derivatives and v = sigma²/M + frame_sigma², the
information of m configurations of a pose is, by the Sherman-Morrison formula::

    sum of A  -  pose_sigma² / (1 + m pose_sigma² / v)  (sum of J/v)' (sum of J/v)

where A = J'J/v + (deviations of the markers' derivatives from J, squared) / sigma², the
information of a configuration without the error common to its pose.
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
"""Ridge, as a share of the mean information of a configuration: it keeps the first choices finite,
and changes no standard deviation once the parameters are determined."""


@dataclass(frozen=True, eq=False)
class ExtraColumns:
    """Further parameters of the linear model, such as the sizes of causes to be separated."""

    names: tuple[str, ...]  # Of m parameters
    # Context -> displacement of the markers in R per unit of each parameter, m, (n, 3, m)
    displacement: Callable[[Context], FloatArray]
    std: FloatArray  # Standard deviations of the priors about 0, (m,)


@dataclass(frozen=True, eq=False)
class DesignInformation:
    """Fisher information of n configurations on the f free parameters of a fit.

    Parameters are divided by `scale`, so that the mean information on each is 1.
    """

    joint_names: tuple[str, ...]  # Of the k joints
    q: FloatArray  # The configurations, rad, (n, k)
    pose: IntArray  # Which pose each belongs to, (n,)
    # Information of each configuration without the error common to its pose, (n, f, f)
    unshared: FloatArray
    # J/v of each frame: mean derivative of its markers over its variance, (n, sensors, 3, f)
    weighted: FloatArray
    weight: FloatArray  # 1/v of a frame, m^-2, (sensors,)
    pose_variance: FloatArray  # pose_sigma², m², (sensors,)
    prior: FloatArray  # Information of the priors, (f, f)
    # Mean of J'J over all markers at the configurations in the box, m² per unit², (f, f)
    tool: FloatArray
    scale: FloatArray  # Unit of each parameter, (f,)
    # Identifiable joint -> its index among the free parameters
    identifiable: Mapping[int, int]
    names: tuple[str, ...]  # Of the free parameters, as in the fit
    per_radian: FloatArray  # Amount of each joint's unit that counts as a radian, (k,)

    @classmethod
    def of(
        cls,
        chain: SerialChain,
        poses: Sequence[PlannedPose],
        sensors: Sequence[ExpectedSensor],
        marker_std_m: float,
        priors: Priors | None = None,
        box: ToolBox | None = None,
        extra: ExtraColumns | None = None,
    ) -> DesignInformation:
        """Compute the information from derivatives of the model at the nominal arm.

        ``chain``: the nominal arm; ``poses``: poses with their joint solutions; ``sensors``: a
        marker that two sensors follow has one position; ``marker_std_m``: prior of the markers'
        positions, per axis, m; ``priors``: of offsets and registrations; ``box``: where the tool
        has to be accurate; None for wherever these poses are; ``extra``: parameters added to
        those of the offsets model, behind them. Raises InputError if there is no configuration, or
        none with the tool in the box; InsufficientDataError if all configurations together do not
        determine the parameters.
        """
        q = np.concatenate([np.empty((0, len(chain))), *(pose.solutions for pose in poses)])
        if not len(q):
            raise InputError('there is no configuration to choose from')
        pose = np.repeat(np.arange(len(poses)), [len(each.solutions) for each in poses])
        priors = priors or Priors()
        model, x = nominal_model(chain, q, sensors, priors)
        prior_list = expected_priors(model, x, marker_std_m, priors)
        measurements = expected_measurements(model, q, pose, sensors)
        rows = expected_rows(model, x, measurements, sensors)
        gauge = find_gauge(model, x, rows, prior_list)
        free = np.setdiff1d(np.arange(model.size), gauge.held)
        derivative = model.natural_jacobian(x, rows)[:, :, free]
        by_x = prior_rows(model, prior_list, x, natural=True)[1][:, free]
        names = [model.names[index] for index in free]
        if extra is not None:
            context = nominal_context(model, x, measurements)
            more = extra.displacement(context)[rows.source]
            derivative = np.concatenate((derivative, more), axis=2)
            by_x = block_diag(by_x, np.diag(1.0 / extra.std))
            names += extra.names

        size = len(names)
        unshared = np.zeros((len(q), size, size))
        weighted = np.zeros((len(q), len(sensors), 3, size))
        weight = np.zeros(len(sensors))
        for index, span in rows.spans:
            sensor = sensors[index]
            count = len(sensor.markers)
            # Sorted by configuration, so that the markers of a frame are consecutive.
            of_frames = derivative[span][np.argsort(rows.source[span])]
            of_frames = of_frames.reshape(len(q), count, 3, -1)
            mean = of_frames.mean(axis=1)
            deviations = (of_frames - mean[:, None]).reshape(len(q), 3 * count, -1)
            weight[index] = 1.0 / (sensor.sigma_m**2 / count + sensor.frame_sigma_m**2)
            unshared += _squares(deviations) / sensor.sigma_m**2 + _squares(mean) * weight[index]
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
        in_box = derivative[inside[measurements.configuration[rows.source]]]
        prior = by_x.T @ by_x
        scale = 1.0 / np.sqrt(np.diag(unshared.mean(axis=0) + prior))
        units = np.outer(scale, scale)
        return cls(
            chain.joint_names,
            q,
            pose,
            unshared * units,
            weighted * scale,
            weight,
            np.array([sensor.pose_sigma_m**2 for sensor in sensors]),
            prior * units,
            np.einsum('nij,nik->jk', in_box, in_box) / len(in_box) * units,
            scale,
            {
                joint: int(np.searchsorted(free, joint))
                for joint in range(len(chain))
                if not gauge.why[joint]
            },
            tuple(names),
            chain.per_radian,
        )

    def __len__(self) -> int:
        """Return the number of configurations."""
        return len(self.q)

    def only(self, kept: IntArray) -> DesignInformation:
        """Return the information of some configurations alone; ``kept``: indices, in order."""
        return replace(
            self,
            q=self.q[kept],
            pose=self.pose[kept],
            unshared=self.unshared[kept],
            weighted=self.weighted[kept],
        )

    def whole_poses(self) -> tuple[DesignInformation, list[IntArray]]:
        """Return the information of whole poses, each with all its configurations.

        Also the indices of the configurations of each pose. Poses have no error in common, so
        that their information adds up. They are in the order of their numbers; in the result a
        pose counts as one configuration, and `q` is its first one.
        """
        members = [np.flatnonzero(self.pose == index) for index in np.unique(self.pose)]
        sums = np.array([self.weighted[indices].sum(axis=0) for indices in members])
        shared = self._shared(sums, np.array([len(indices) for indices in members]))
        unshared = np.array([self.unshared[indices].sum(axis=0) for indices in members]) - shared
        first = [indices[0] for indices in members]
        poses = replace(
            self,
            q=self.q[first],
            pose=np.arange(len(members)),
            unshared=unshared,
            weighted=np.zeros((len(members), *self.weighted.shape[1:])),
        )
        return poses, members

    def total(self, chosen: Sequence[int]) -> FloatArray:
        """Information of chosen configurations together with the priors, (f, f).

        The information that is lost to the error common to each pose is subtracted.
        ``chosen``: indices of configurations; () gives the priors alone. In units of `scale`.
        """
        which = np.array(chosen, dtype=np.int64)
        sums, count = self._sums(chosen)
        visited = np.flatnonzero(count)
        shared: FloatArray = self._shared(sums[visited], count[visited]).sum(axis=0)
        return self.prior + self.unshared[which].sum(axis=0) - shared

    def with_each(self, chosen: Sequence[int], among: IntArray) -> FloatArray:
        """Return the information of the chosen configurations plus each of m others, (m, f, f).

        ``among``: indices of the others, none of which may be chosen.
        """
        sums, count = self._sums(chosen)
        pose = self.pose[among]
        before = self._shared(sums, count)[pose]
        after = self._shared(sums[pose] + self.weighted[among], count[pose] + 1)
        return self.total(chosen) + self.unshared[among] - after + before

    def gains(self, chosen: Sequence[int], root: FloatArray) -> FloatArray:
        """Return the first-order decrease of trace(L' M^-1 L) by each configuration, (n,).

        M is the information of the configurations chosen so far (``chosen``: indices), L the
        weights of the goal (`Goal.weights`). The decrease is trace(K' dM K) for the
        information dM that the configuration adds, with K = M^-1 L, which is ``root``, (f, r).
        """
        sums, count = self._sums(chosen)
        of_sums, of_each = sums @ root, self.weighted @ root
        factor = self._factor(count)
        before = np.einsum('ps,psir,psir->p', factor, of_sums, of_sums)[self.pose]
        after = of_sums[self.pose] + of_each
        shared = np.einsum('ns,nsir,nsir->n', self._factor(count + 1)[self.pose], after, after)
        unshared = self.unshared.reshape(len(self), -1) @ (root @ root.T).ravel()
        result: FloatArray = unshared - shared + before
        return result

    def _sums(self, chosen: Sequence[int]) -> tuple[FloatArray, IntArray]:
        """Sums of J/v over the chosen configurations of each pose, (poses, s, 3, f), and counts.

        J/v is the attribute `weighted`: for each of s sensors the mean derivative of its
        markers over its variance. The counts of chosen configurations are (poses,). Both are 0
        for a pose without one. ``chosen``: indices of configurations.
        """
        which = np.array(chosen, dtype=np.int64)
        sums = np.zeros((int(self.pose.max()) + 1, *self.weighted.shape[1:]))
        np.add.at(sums, self.pose[which], self.weighted[which])
        return sums, np.bincount(self.pose[which], minlength=len(sums))

    def _factor(self, count: IntArray) -> FloatArray:
        """Factors of the error that the configurations of a pose share, (p, s), m².

        They are pose_sigma² / (1 + m pose_sigma² / v) for s sensors and p poses, with the
        variances pose_sigma² of the shared error and v of a frame of the sensor. ``count``:
        number m of configurations of each pose, (p,).
        """
        return self.pose_variance / (1.0 + count[:, None] * self.pose_variance * self.weight)

    def _shared(self, sums: FloatArray, count: IntArray) -> FloatArray:
        """Return the information lost to the error common to each pose, (poses, f, f).

        ``sums, count``: for each pose, as returned by `_sums`.
        """
        rooted = np.sqrt(self._factor(count))[:, :, None, None] * sums
        return _squares(rooted.reshape(len(sums), 3 * len(self.weight), len(self.scale)))

    def covariance(self, chosen: Sequence[int]) -> FloatArray:
        """Return the expected covariance of the free parameters, rad and m, (f, f).

        ``chosen``: indices of configurations. Directions that nothing determines have a large
        variance (`UNKNOWN`), not an infinite one.
        """
        return np.linalg.inv(self.finite(self.total(chosen))) * np.outer(self.scale, self.scale)

    def finite(self, information: FloatArray) -> FloatArray:
        """Return information (..., f, f) with a ridge (`UNKNOWN`), so that it can be inverted."""
        return information + UNKNOWN * np.eye(len(self.scale))

    def joint_std(self, chosen: Sequence[int]) -> dict[str, float | None]:
        """Return each joint's expected std by name, rad or m; None if not identifiable.

        ``chosen``: indices of the configurations that are measured.
        """
        variance = np.diag(self.covariance(chosen))
        return {
            name: float(np.sqrt(variance[self.identifiable[joint]]))
            if joint in self.identifiable
            else None
            for joint, name in enumerate(self.joint_names)
        }

    def joint_rms(self, chosen: Sequence[int]) -> float:
        """Return the root mean square of the identifiable joints' standard deviations, rad.

        That of a prismatic joint is divided by `SerialChain.per_radian`. NaN if no joint is
        identifiable. ``chosen``: indices of configurations.
        """
        std = [
            value / unit
            for value, unit in zip(self.joint_std(chosen).values(), self.per_radian)
            if value is not None
        ]
        return float(np.sqrt(np.mean(np.square(std))))

    def tool_rms(self, chosen: Sequence[int]) -> float:
        """Return the root mean square 3-D error of the predicted markers in the box, m.

        ``chosen``: indices of the configurations measured; the mean is over the markers at all
        candidate configurations with the tool in the box (at all, without a box).
        """
        covariance = np.linalg.inv(self.finite(self.total(chosen)))
        return float(np.sqrt(np.sum(covariance * self.tool)))


def nominal_context(model: Model, x: FloatArray, measurements: Measurements) -> Context:
    """Return the context of effects at the nominal arm, without times and previous moves.

    ``x``: nominal parameters, (size,).
    """
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
    """Return J'J for each matrix J, (..., f, f); ``values``: the matrices, (..., rows, f)."""
    return np.swapaxes(values, -1, -2) @ values

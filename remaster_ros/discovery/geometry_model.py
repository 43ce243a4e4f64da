"""Link lengths and axis tilts beside the zero-offsets, all at once, and none of them selected.

No arm is its drawing. Every length is a random effect about the drawing, and so is every tilt; one
variance for all lengths and one for all tilts follow from the restricted likelihood (`evidence`),
and neither is taken to be less than the tolerance of the drawing: what offsets imitate exactly
leaves nothing in the residuals that could show it. Two things follow::

    an offset's error if the drawing is off:   Var δ = Var(δ | drawing) + B S B'
    a robot model to load:                     origins moved by E[g | data], offsets fitted with it

with B = (A'WA + P)⁻¹ A'WZ the response of the offsets model A to a unit of each length and tilt
Z, and S their variances. Columns are in units of the marker's RMS displacement, so that one
tolerance in metres serves lengths and tilts alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from remaster_ros.calibration.comparison import predicted_rows
from remaster_ros.calibration.estimate import Estimate, estimate, of_positions_alone
from remaster_ros.calibration.identifiability import OPEN_ANGLE
from remaster_ros.calibration.laplace import Mode
from remaster_ros.calibration.priors import TIGHTEST_PRIOR, prior_rows
from remaster_ros.calibration.result import FitResult
from remaster_ros.discovery.effects import joint_axis_tilt, link_length
from remaster_ros.discovery.effects.base import Candidate
from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.evidence import solve
from remaster_ros.discovery.random_effects import Family, by_members
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.thinning import of_spread_poses
from remaster_ros.discovery.to_extension import extension_of, offsets_of, root_of_inverse
from remaster_ros.errors import InsufficientDataError
from remaster_ros.kinematics.serial_chain import SerialChain
from remaster_ros.kinematics.transforms import rotation_vector_to_matrix
from remaster_ros.linear_algebra import one_thread
from remaster_ros.types import BoolArray, FloatArray, IntArray

# A gain counts from so many of its standard errors on: of arms that are their drawing one in forty
# gets lengths and tilts by chance.
PLAINLY = 2.0
# The scatter of a gain is not known from fewer.
FEWEST_POSES = 5


@dataclass(frozen=True, eq=False)
class GeometryModel:
    """Robot model with lengths and tilts as fitted to a session; k joints, m lengths and tilts."""

    # Of the drawing: RMS displacement of the marker by each length and each tilt, m
    tolerance_m: float
    members: tuple[Candidate, ...]  # Their candidates; ``variant`` is the axis
    # Standard deviation of each before it is measured, as RMS displacement of the marker, m, (m,)
    std_m: FloatArray
    # What one such standard deviation of each does to each zero-offset of the fit that takes the
    # arm to be its drawing, rad, m of joints that slide, (k, m)
    offset_moves: FloatArray
    # Of each joint's origin, in the frame of the link before, m, and of its frame, a rotation
    # vector, rad, (k, 3) each
    shifts: FloatArray
    turns: FloatArray
    # Zero-offsets fitted together with it, those that the gauge holds at 0, rad or m, (k,)
    joint_offsets: FloatArray
    # Measured minus predicted position of every row of the session, m, (n, 3), with this geometry
    # and on the drawing
    errors: FloatArray
    drawing_errors: FloatArray
    judged: BoolArray  # By which of them it is judged: those held out, (n,)
    poses: IntArray  # Which rows are of one pose, (n,)
    # Of the fit of the members beside the offsets: ``members`` are its first further parameters
    mode: Mode

    @property
    def held_out_m(self) -> float:
        """Mean 3-D error of the rows in `judged` with this geometry, m; NaN if there are none."""
        return mean_length(self.errors[self.judged])

    @property
    def drawing_held_out_m(self) -> float:
        """Mean 3-D error of the rows in `judged` with the drawing's geometry, m; NaN if none."""
        return mean_length(self.drawing_errors[self.judged])

    @property
    def is_better(self) -> bool:
        """Whether this model predicts held-out poses clearly better than the drawing.

        Clearly: the mean gain of the poses, each counted once, exceeds two of its standard
        errors. With fewer than 5 poses a smaller mean error is enough; False without any.
        """
        errors, drawn = (
            np.linalg.norm(vectors[self.judged], axis=1)
            for vectors in (self.errors, self.drawing_errors)
        )
        poses, of = np.unique(self.poses[self.judged], return_inverse=True)
        if len(poses) < FEWEST_POSES:
            return self.held_out_m < self.drawing_held_out_m
        gains = np.bincount(of, drawn - errors) / np.bincount(of)
        return bool(gains.mean() > PLAINLY * gains.std(ddof=1) / np.sqrt(len(poses)))

    def beside(self, offsets_fit: FitResult, gross: Sequence[int]) -> GeometryModel:
        """Return a copy that is compared with a given fit of the zero-offsets alone.

        Parameters
        ----------
        offsets_fit
            The fit that could be loaded instead; its residuals become `drawing_errors`.
        gross
            ``observation`` of the gross errors, which are taken out of `judged`.
        """
        counts = ~np.isin(offsets_fit.measurements.observation, gross)
        return replace(
            self, drawing_errors=offsets_fit.residuals_after, judged=self.judged & counts
        )

    def offsets_std(self, std: FloatArray) -> FloatArray:
        """Return standard deviations of the zero-offsets of an arm that differs from its drawing.

        ``std``: those of an arm exactly as drawn, rad or m, (k,). The change of an offset by each
        length and tilt of one prior standard deviation is added in quadrature.
        """
        moved: FloatArray = np.hypot(std, np.linalg.norm(self.offset_moves, axis=1))
        return moved

    def largest_imitation(self, joint: int) -> tuple[Candidate, float]:
        """Return the length or tilt that moves a joint's zero-offset most, and by how much.

        Each with the size that the drawing's tolerance allows.

        Parameters
        ----------
        joint
            From 0.

        Returns
        -------
        Candidate, float
            The length or tilt, and the change of the offset, rad or m.
        """
        moves = np.abs(self.offset_moves[joint]) * (self.tolerance_m / self.std_m)
        most = int(np.argmax(moves))
        return self.members[most], float(moves[most])


@one_thread
def geometry_model(found: Estimate, causes: Sequence[Candidate] = ()) -> GeometryModel | None:
    """Fit all lengths and tilts beside the zero-offsets; None if they cannot be fitted.

    Parameters
    ----------
    found
        The session's fit on the drawing, with the drawing's tolerance among its priors.
    causes
        Errors of the measurement, fitted beside them: they are no errors of the arm.
    """
    found = of_positions_alone(found)
    tolerance_m = found.problem.priors.geometry_tolerance_m
    drawing = _fitted(found, causes)
    found = _without_open_offsets(found)
    # What variances follow from: a fit of all rows follows.
    spread_rows = of_spread_poses(found.problem.measurements, found.kept)
    data = Residuals.of(found).only(spread_rows)
    families = [
        family
        for members in (_lengths(data.context), _tilts(data.context))
        if (family := Family.of(data, members[0].name, members, tolerance_m)) is not None
    ]
    candidates = [*(family.candidate for family in families), *causes]
    solution = solve(data, candidates) if families else None
    if drawing is None or solution is None:
        return None
    factors = dict(zip(solution.candidates, solution.smoothness, strict=True))
    std_m = np.concatenate(
        [np.full(len(kind.members), factors[kind.candidate] ** -0.5) for kind in families]
    )
    members = tuple(member for kind in families for member in kind.members)
    solution = by_members(solution, families)
    try:
        mode = estimate(found.problem, extension_of(data, solution, found)).mode
    except InsufficientDataError:
        return None
    model = mode.linearisation.posterior.model
    x = model.natural(mode.z)
    # Errors of the measurement come behind all members.
    loaded = _loaded(found, solution.candidates, model.theta(x), causes)
    if loaded is None:
        return None
    return GeometryModel(
        tolerance_m,
        members,
        std_m,
        _offset_moves(found, data, families) * std_m,
        *loaded,
        _errors(drawing),
        found.problem.measurements.is_validation,
        found.problem.measurements.pose,
        mode,
    )


def _loaded(
    found: Estimate,
    candidates: Sequence[Candidate],
    theta: FloatArray,
    causes: Sequence[Candidate],
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray] | None:
    """Return shifts, turns, zero-offsets and errors of the arm that fitted candidates describe.

    The joints' origins are shifted, m, and turned, rad, (k, 3) each; then zero-offsets, (k,),
    registrations and markers are fitted again on that arm, which leaves errors, m, (n, 3).
    ``candidates``: lengths and tilts; ``theta``: values of their parameters; ``causes``: errors
    of the measurement to fit, too. None if that cannot be fitted.
    """
    chain = found.problem.chain
    shifts, turns = np.zeros((2, len(chain), 3))
    at = 0
    for candidate in candidates:
        values = theta[at : at + candidate.size]
        at += candidate.size
        if candidate.model_change is not None:
            shifts[candidate.model_change.joint] += values @ candidate.model_change.shifts
            turns[candidate.model_change.joint] += values @ candidate.model_change.turns
    try:
        moved = estimate(replace(found.problem, chain=_moved(chain, shifts, turns)))
    except InsufficientDataError:
        return None
    fit = _fitted(moved, causes)
    if fit is None:
        return None
    return shifts, turns, fit.posterior.model.offsets(fit.mode.z), _errors(fit)


def mean_length(errors: FloatArray) -> float:
    """Return the mean length of errors, m, (n, 3); NaN of none."""
    return float(np.linalg.norm(errors, axis=1).mean()) if len(errors) else float('nan')


def _fitted(found: Estimate, causes: Sequence[Candidate]) -> Estimate | None:
    """Return the fit with some causes as further parameters; None if they cannot be fitted.

    ``found`` itself without causes.
    """
    if not causes:
        return found
    data = Residuals.of(found)
    solution = solve(data, causes)
    if solution is None:
        return None
    try:
        return estimate(found.problem, extension_of(data, solution, found))
    except InsufficientDataError:
        return None


def _errors(fit: Estimate) -> FloatArray:
    """Return measured minus modelled position of every row at a fit's mode, m, (n, 3)."""
    predicted = predicted_rows(fit.problem, fit.posterior.model, fit.mode.z)
    return fit.problem.measurements.position - predicted


def _without_open_offsets(found: Estimate) -> Estimate:
    """Return the fit with zero-offsets held at 0 that are known to no better than `OPEN_ANGLE`.

    ``found`` itself if there are none. Lengths and tilts linearised at a wrong offset would be
    those of another arm.
    """
    _, std = offsets_of(found)
    chain = found.problem.chain
    unknown = {
        chain.joint_names[i]: (0.0, TIGHTEST_PRIOR)
        for i in np.flatnonzero(std > OPEN_ANGLE * chain.per_radian)
    }
    if not unknown:
        return found
    priors = found.problem.priors
    offset_priors = replace(priors, joint_offsets={**unknown, **priors.joint_offsets})
    return estimate(replace(found.problem, priors=offset_priors))


def _lengths(context: Context) -> list[Candidate]:
    """Return candidates of a length along each axis of each link's frame.

    Along the link itself in place of an axis that is parallel to it.
    """
    # A link's own direction is one more where it is none of the axes of its frame.
    candidates = list(link_length.candidates(context))
    per_link = {
        joint: [c for c in candidates if c.joints == (joint,)] for joint in context.links()
    }
    return [
        candidate
        for link_candidates in per_link.values()
        for candidate in link_candidates
        if candidate.variant != 'along' or len(link_candidates) <= len('xyz')
    ]


def _tilts(context: Context) -> list[Candidate]:
    """Return candidates of a tilt of each joint but the first about one axis of its frame."""
    return [candidate for candidate in joint_axis_tilt.candidates(context) if candidate.size == 1]


def _offset_moves(found: Estimate, data: Residuals, families: Sequence[Family]) -> FloatArray:
    """Return the change of the zero-offsets by a unit weight of each length and tilt, (k, m).

    In a fit of an arm exactly as drawn to errors that the length or tilt causes; rad or m, per m
    RMS displacement of the marker. ``families``: random effects of lengths and of tilts.
    """
    free = found.posterior.free
    known = data.full_jacobian[data.rows.source][:, :, free]
    x = found.model.natural(found.mode.z)
    rows = prior_rows(found.model, found.posterior.priors, x, natural=True)[1][:, free]
    both = np.concatenate((known, data.columns([family.candidate for family in families])), axis=2)
    white = data.noise_model.whitened(both, data.noise).reshape(3 * len(data), -1)
    moved = np.zeros((found.model.size, white.shape[1] - len(free)))
    # The fit of the offsets to errors of that size.
    offset_columns = white[:, : len(free)]
    root = root_of_inverse(offset_columns.T @ offset_columns + rows.T @ rows)
    moved[free] = root @ (root.T @ (offset_columns.T @ white[:, len(free) :]))
    return moved[: found.model.joints]


def _moved(chain: SerialChain, shifts: FloatArray, turns: FloatArray) -> SerialChain:
    """Return a copy of an arm with its joints' origins shifted and turned.

    ``shifts``: m, in the frame of the link before; ``turns``: rotation vectors, rad; (k, 3)
    each.
    """
    T_fixed = chain.T_fixed.copy()
    T_fixed[:-1, :3, 3] += shifts
    T_fixed[:-1, :3, :3] = T_fixed[:-1, :3, :3] @ rotation_vector_to_matrix(turns)
    return replace(chain, T_fixed=T_fixed)

"""Kinds of errors as random effects: all members of a kind at once, with one variance.

No joint is quite stiff, no link its drawing, no code disc centred. Which member of a kind errs is
not chosen: every one does by some amount, drawn from one normal distribution whose variance the
restricted likelihood gives (`evidence`; Patterson & Thompson 1971). A kind that the data do not
show gets none, and costs the others nothing.

The columns of a member are scaled so that its weight is the RMS displacement of the marker over
the rows worked on, m. An error of a joint's angle counts as if every joint moved the marker as
much: joints of one arm err by angles of one size, and near the axis of its joint a marker would
let degrees be as likely as minutes elsewhere. No kind is larger than its effect's plausible range.
A member with a smoothness penalty P enters by the columns of P^(−1/2).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from remaster_ros.discovery.effects.base import RANDOM, Candidate, Design
from remaster_ros.discovery.effects.context import Context
from remaster_ros.discovery.effects.registry import EFFECTS
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.discovery.solution import Covariances, Solution
from remaster_ros.types import FloatArray

# A member that displaces the markers by no more than this per unit is not seen, m.
NOTHING = 1e-12
# Directions of a penalised member with a smaller share of its largest displacement, in square.
# Coarser, and a fit of curves ends on a plateau, four times as far from held-out poses.
LEAST_SHARE = 1e-7


@dataclass(frozen=True, eq=False)
class Family:
    """Random effects of one kind of error: weights of all its candidates share one variance."""

    candidate: Candidate  # Of the weights of all members, m, with a penalty of one
    members: tuple[Candidate, ...]  # The candidates that displace a marker
    # Parameters of each member, in its unit, from its weights, (member's size, weights)
    maps: tuple[FloatArray, ...]
    # Factor from the smoothness of the family to that of each penalised member, and from the
    # precision of the weights to that of the parameters of the others: RMS displacement per unit
    # squared, (member's size,) or (1,)
    scales: tuple[FloatArray, ...]

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the parameters of all members."""
        return tuple(name for member in self.members for name in member.parameters)

    @classmethod
    def of(
        cls,
        data: Residuals,
        name: str,
        members: Sequence[Candidate],
        least: float = 0.0,
        alike: Sequence[Candidate] = (),
    ) -> Family | None:
        """Make the family of some candidates (members); None if none of them displaces a marker.

        ``name``: of the family; ``least``: lower limit on the standard deviation of its weights,
        m. Errors of joint angles are scaled to m by one RMS lever arm, m/rad, of all joints of
        the candidates ``alike``, or of ``members`` if that is empty.
        """
        seen, maps, scales, largest = [], [], [], []
        lever = _lever(data, alike or members)
        for member in members:
            moved = data.columns([member])
            parts = np.sum(moved**2, axis=(0, 1)) / len(data) > NOTHING**2
            if not parts.any():
                continue
            seen.append(member)
            design = member.columns(data.part)
            of_a_height = np.inf
            if design.at is not None:
                # What slides counts by the angle that it counts as.
                of_a_height = lever / data.part.chain.per_radian[design.at]
                moved = of_a_height * design.values[:, None, :]
            if member.penalty is None:
                square = np.sum(moved**2, axis=(0, 1)) / len(data)
                unit = np.sqrt(np.where(parts, square, 1.0))
                maps.append((np.eye(member.size) / unit)[:, parts])
                scales.append(square)
                largest.append((member.largest or np.inf) * float(unit[parts].max()))
                continue
            values, vectors = np.linalg.eigh(member.penalty)
            root = vectors / np.sqrt(np.maximum(values, np.finfo(float).eps * values[-1]))
            share = np.sum((moved @ root) ** 2, axis=(0, 1)) / len(data)
            kept = share > LEAST_SHARE * share.max()
            maps.append(root[:, kept] / np.sqrt(share.sum()))
            scales.append(np.array([share.sum()]))
            largest.append((member.largest or np.inf) * of_a_height)
        if not seen:
            return None
        count = sum(mapping.shape[1] for mapping in maps)
        candidate = Candidate(
            name=name,
            place=seen[0].place,
            driver=seen[0].driver,
            form=RANDOM,
            parameters=tuple(f'{name}#{index}' for index in range(count)),
            unit='m',
            columns=partial(_columns, members=tuple(seen), maps=tuple(maps)),
            drawn_from=1,
            penalty=np.eye(count),
            least=least,
            largest=max(largest),
        )
        return cls(candidate, tuple(seen), tuple(maps), tuple(scales))


def _lever(data: Residuals, members: Sequence[Candidate]) -> float:
    """Return the RMS displacement of the marker by a radian of the candidates' joints, m.

    Joints that slide count by the length that stands for a radian; 0 without joints.
    """
    joints = sorted({member.joints[0] - 1 for member in members if member.place == 'joint_angle'})
    jacobian = (data.part.jacobian * data.part.chain.per_radian)[:, :, joints]
    return float(np.sqrt(np.sum(jacobian**2) / max(1, len(jacobian) * len(joints))))


def _columns(context: Context, members: Sequence[Candidate], maps: Sequence[FloatArray]) -> Design:
    """Return the displacement of the marker by a unit of each weight of a family, as columns.

    ``maps``: for each of ``members`` the matrix that turns its weights into its parameters,
    (parameters, weights).
    """
    parts = [
        member.columns(context).displacement(context) @ mapping
        for member, mapping in zip(members, maps, strict=True)
    ]
    return Design(None, np.concatenate(parts, axis=2))


def kinds(
    data: Residuals, candidates: Sequence[Candidate], singles: Sequence[Candidate] = ()
) -> list[Family]:
    """Return a family of random effects for each effect (kind of error) among some candidates.

    Left out are changes in mid-session; candidates with the name, joints and subject of one of
    ``singles``, the causes that are fitted by themselves; candidates that share a parameter with
    these or with a larger member; and variants by `Effect.in_family`. Effects with thousands of
    candidates (`Effect.many`: orders of a gear, steps, unnamed) have no family, as a single one
    would be lost among so many.
    """
    taken = {name for candidate in singles for name in candidate.parameters}
    taken_places = {(candidate.name, candidate.joints, candidate.subject) for candidate in singles}
    members: dict[str, list[Candidate]] = {}
    for candidate in sorted(candidates, key=lambda candidate: -candidate.size):
        effect = EFFECTS[candidate.name]
        if (
            effect.many
            or candidate.changes is not None
            or not effect.in_family(candidate)
            or taken & set(candidate.parameters)
        ):
            continue
        if (candidate.name, candidate.joints, candidate.subject) not in taken_places:
            members.setdefault(candidate.name, []).append(candidate)
            taken |= set(candidate.parameters)
    families = (Family.of(data, f'every {name}', mine) for name, mine in members.items())
    return [family for family in families if family is not None]


def by_members(solution: Solution, families: Sequence[Family]) -> Solution:
    """Return a copy of a solution with its families replaced by their members.

    It is the same fit: each member has the prior that the family gives it.
    """
    known = {family.candidate: family for family in families}
    candidates: list[Candidate] = []
    maps: list[FloatArray] = []
    smoothness: list[float] = []
    ridge: list[FloatArray] = []
    precisions = solution.weight_precisions()
    for candidate, where, factor in zip(
        solution.candidates, solution.slices(), solution.smoothness, strict=True
    ):
        family = known.get(candidate)
        if family is None:
            candidates.append(candidate)
            maps.append(np.eye(candidate.size))
            smoothness.append(factor)
            ridge.append(solution.ridge[where])
            continue
        candidates += family.members
        maps += family.maps
        for member, scale in zip(family.members, family.scales, strict=True):
            if member.penalty is None:
                smoothness.append(np.nan)
                ridge.append(precisions[candidate] * scale)
            else:
                smoothness.append(float(precisions[candidate] * scale[0]))
                ridge.append(np.zeros(member.size))
    together = _diagonal(maps)
    p = len(solution.base)

    def covariances() -> tuple[FloatArray, FloatArray]:
        full_map = _diagonal([np.eye(p), together])
        full = full_map @ solution.full_covariance @ full_map.T
        return full, full

    return replace(
        solution,
        candidates=tuple(candidates),
        parameters=together @ solution.parameters,
        smoothness=np.array(smoothness),
        ridge=np.concatenate(ridge) if ridge else np.zeros(0),
        covariances=Covariances(covariances),
    )


def _diagonal(blocks: Sequence[FloatArray]) -> FloatArray:
    """Return the block-diagonal matrix of blocks, which need not be square."""
    rows = np.cumsum([0, *(block.shape[0] for block in blocks)])
    columns = np.cumsum([0, *(block.shape[1] for block in blocks)])
    result = np.zeros((rows[-1], columns[-1]))
    for block, row, column in zip(blocks, rows, columns, strict=False):
        result[row : row + block.shape[0], column : column + block.shape[1]] = block
    return result

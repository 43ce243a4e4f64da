"""Products of columns that turn a joint, from their angles alone.

Such a column displaces row i by f_i times the derivative of its position by the joint's angle, so
that three quarters of its products with vectors can be done once for all columns of a joint:
X'v = f'(J'v), a third of the work, and no displacement is ever computed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from remaster_ros.calibration.noise import Noise
from remaster_ros.discovery.catalogue import Catalogue
from remaster_ros.discovery.residuals import Residuals
from remaster_ros.types import BoolArray, FloatArray, IntArray

# Cells of more columns have few like them.
FEW = 3
# What the others explain all but this share of needs the columns themselves: in single precision
# the differences here have no more than three figures then.
CLEAR = 1e-2


class Products(NamedTuple):
    """Products of the columns of cells, in units of the noise.

    Attributes
    ----------
    norm
        Of each column, (cells, m); the others are of columns in units of it.
    gram
        Of the columns less what is projected out, (cells, m, m).
    pull
        Of these with residuals, (cells, m, residuals).
    """

    norm: FloatArray
    gram: FloatArray
    pull: NDArray[np.float32]

    def of(self, chosen: BoolArray) -> Products:
        """Return those of some of the cells."""
        return Products(self.norm[chosen], self.gram[chosen], self.pull[chosen])


def suit(data: Residuals, catalogue: Catalogue) -> BoolArray:
    """Return the columns of which cells can be multiplied by their angles, (cells,)."""
    suiting: BoolArray = (catalogue.joint >= 0) & (catalogue.sizes <= FEW) & ~catalogue.penalised
    # The means of frames are left to what whitens.
    return suiting & (data.rows.frame is None)


@dataclass(frozen=True, eq=False)
class AtJoints:
    """What columns of each joint are multiplied with.

    Attributes
    ----------
    catalogue
        All columns.
    pulls
        By joint, for the products with residuals, (joints, n, residuals).
    taken
        By joint, for what is projected out, (joints, n, p).
    own
        By joint, precision of each row, (joints, n).
    sums
        By joint, takes angles to the sums over each pose whose squares are less precise, each
        times the root of by how much, (3 poses, n).
    """

    catalogue: Catalogue
    pulls: NDArray[np.float32]
    taken: NDArray[np.float32]
    own: FloatArray
    sums: list[Any]

    @classmethod
    def of(
        cls,
        data: Residuals,
        catalogue: Catalogue,
        noise: Noise,
        residuals: NDArray[np.float32],
        projected: NDArray[np.float32],
    ) -> AtJoints:
        """Multiply all that is the same for the columns of a joint.

        Parameters
        ----------
        data, catalogue
            The residuals and the cells, some of which `suit`.
        noise
            To whiten the columns by.
        residuals
            What they are multiplied with, in units of the noise, (3n, c).
        projected
            T, where I − T T' is projected on, (3n, p).
        """
        model, rows, n = data.noise_model, data.rows, len(data)
        # In double precision: the whitened parts nearly cancel where poses share large errors.
        jacobian = catalogue.jacobian.astype(float)
        if model.frames is not None:
            jacobian = model.frames @ jacobian

        def by_joint(white: NDArray[np.float32]) -> NDArray[np.float32]:
            # What whitens is symmetric in the axes of the frames, to which it turns vectors.
            vectors = white.reshape(n, 3, -1).astype(float)
            if model.frames is not None:
                vectors = model.frames.transpose(0, 2, 1) @ vectors
            joined = jacobian.transpose(0, 2, 1) @ model.whitened(vectors, noise)
            return np.ascontiguousarray(joined.transpose(1, 0, 2), dtype=np.float32)

        own, shared = model.precisions(noise)
        weight = np.sqrt(np.maximum(shared, 0.0))[rows.group_of_row]
        place = (3 * rows.group_of_row[:, None] + np.arange(3)).ravel()
        at = place, np.repeat(np.arange(n), 3)
        sums = [
            csr_array(((weight * turned).ravel(), at), shape=(3 * len(shared), n))
            for turned in jacobian.transpose(2, 0, 1)
        ]
        return cls(
            catalogue,
            by_joint(residuals),
            by_joint(projected),
            np.einsum('na,naj->jn', own, jacobian**2),
            sums,
        )

    def products(self, batch: IntArray) -> tuple[Products, BoolArray]:
        """Return the products of cells of one size and joint, and for which they are exact enough.

        For the others they are of no meaning.
        """
        catalogue = self.catalogue
        joint, columns = catalogue.joint[batch[0]], catalogue.columns(batch)
        count, m = len(batch), int(catalogue.sizes[batch[0]])
        angles = np.take(catalogue.features, catalogue.position[columns], axis=1)
        pull = (angles.T @ self.pulls[joint]).reshape(count, m, -1)
        taken = (self.taken[joint].T @ angles).reshape(-1, count, m)
        angles = angles.astype(float)
        summed = (self.sums[joint] @ angles).reshape(-1, count, m)
        weighted = (self.own[joint][:, None] * angles).reshape(-1, count, m)
        angles = angles.reshape(-1, count, m)
        whole, gram = np.empty((2, count, m, m))
        for a in range(m):
            for b in range(a + 1):
                square = np.einsum('nc,nc->c', weighted[:, :, a], angles[:, :, b])
                square -= np.einsum('nc,nc->c', summed[:, :, a], summed[:, :, b])
                whole[:, a, b] = whole[:, b, a] = square
                less = np.einsum('nc,nc->c', taken[:, :, a], taken[:, :, b])
                gram[:, a, b] = gram[:, b, a] = square - less
        norm = np.sqrt(np.maximum(np.einsum('cii->ci', whole), 0.0))
        unit = np.where(norm > 0.0, norm, 1.0)
        gram /= unit[:, :, None] * unit[:, None, :]
        pull /= unit[:, :, None].astype(np.float32)
        return Products(norm, gram, pull), np.linalg.eigvalsh(gram)[:, 0] > CLEAR

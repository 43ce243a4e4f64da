"""discovery.json: what was found, as other programs read it (format ``remaster-discovery/1``)."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from remaster_ros.discovery.confirmation import Confirmation
from remaster_ros.discovery.discover import Discovery
from remaster_ros.discovery.explain import FoundEffect
from remaster_ros.reports import schemas
from remaster_ros.reports.fit_json import finite, fit_content, read_result, remove_report
from remaster_ros.session.files import make_folder, write_atomically
from remaster_ros.version import __version__

DISCOVERY_FILE = 'discovery.json'


def discovery_content(
    discovery: Discovery, confirmation: Confirmation | None = None
) -> schemas.Discovered:
    """Return a discovery as discovery.json has it."""
    fit = fit_content(discovery.fit)
    before, before_std = discovery.offsets_before
    content = schemas.Discovered(
        format=schemas.DISCOVERY_FORMAT,
        version=__version__,
        robot=fit.robot,
        session=fit.session,
        verdict=discovery.verdict,
        effects=[_effect(effect) for effect in discovery.effects],
        gain=schemas.Gain(
            discovery.gain.held_out_rms_before_m,
            discovery.gain.held_out_rms_after_m,
            discovery.gain.noise_floor_m,
        ),
        metrics=discovery.gain.metrics,
        noise=schemas.NoiseOfDiscovery(
            pose_common_fraction=discovery.pose_common_fraction,
            outliers=[observation for observation, _ in discovery.outliers],
            heteroscedastic=discovery.noise_by_range,
            sensors=fit.noise,
        ),
        untestable=dict(discovery.untestable),
        joint_offsets_before=[
            schemas.OffsetBefore(
                name, float(np.degrees(before[i])), finite(np.degrees(before_std[i]))
            )
            for i, name in enumerate(discovery.fit.joint_names)
        ],
        joint_offsets_after=fit.joint_offsets,
        sampler=fit.sampler,
    )
    if discovery.thinning is not None:
        content.rows_searched = msgspec.convert(
            discovery.thinning, schemas.SearchedRows, from_attributes=True
        )
    if confirmation is not None:
        content.confirmation = schemas.Confirmed(
            rms_before_m=confirmation.rms_before_m,
            rms_after_m=confirmation.rms_after_m,
            rms_own_m=confirmation.rms_own_m,
            same_offsets=confirmation.same_offsets,
            carried_over=confirmation.carried_over,
            confirmed=confirmation.confirmed,
            effects=[
                schemas.ConfirmedEffect(effect.name, list(effect.joints), finite(share))
                for effect, share in zip(discovery.effects, confirmation.effects, strict=False)
            ],
        )
    return content


def _effect(effect: FoundEffect) -> schemas.Effect:
    return schemas.Effect(
        name=effect.name,
        joints=list(effect.joints),
        place=effect.place,
        driver=effect.driver,
        form=effect.form,
        parameters=[
            schemas.EffectParameter(p.name, p.value, p.std, p.unit) for p in effect.parameters
        ],
        p_value=effect.p_value,
        log_evidence_gain=effect.log_evidence_gain,
        confusable_with=[
            schemas.LookAlike(
                other.name, list(other.joints), other.log_evidence_gain, other.separate_by
            )
            for other in effect.confusable_with
        ],
        cause=effect.cause,
        size_m=effect.size_m,
        share=effect.share,
    )


def save_discovery(
    discovery: Discovery,
    folder: str | os.PathLike[str],
    confirmation: Confirmation | None = None,
    figures: bool = True,
) -> Path:
    """Write discovery.json and, with figures, the report; return what to open.

    Raises
    ------
    InputError
        The folder cannot be written to.
    """
    folder = Path(folder)
    make_folder(folder)
    content = discovery_content(discovery, confirmation)
    encoded = schemas.encode(content)
    # What others rely on is checked before it is written.
    msgspec.json.decode(encoded, type=schemas.Discovered)
    write_atomically(folder / DISCOVERY_FILE, encoded)
    if not figures:
        remove_report(folder)
        return folder / DISCOVERY_FILE
    # Matplotlib and the templates take a second to import: only where a report is made.
    from remaster_ros.reports.discovery_report import write_discovery_report

    return write_discovery_report(discovery, confirmation, msgspec.to_builtins(content), folder)


def read_discovery(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read discovery.json and check it against the contract; further keys are kept as they are.

    Raises
    ------
    InputError
        One line naming the file, the key and the remedy.
    """
    return read_result(
        Path(path), schemas.Discovered, schemas.DISCOVERY_FORMAT, DISCOVERY_FILE, 'discover'
    )

# SPDX-License-Identifier: Apache-2.0
"""Confirmation by a person of the plan that the arm is about to follow.

A confirmation is of one plan, by its fingerprint: the tours of registration and collection, and a
tour that was planned again, are different plans. It is kept in memory only: a restarted planner
has none.
"""

from __future__ import annotations

import hashlib

import numpy as np

from remaster_ros.planning.tour_order import Tour

CONFIRM, COLLECT = '/remaster/confirm', '/remaster/collect'


def fingerprint(tour: Tour) -> str:
    """Return a checksum of the poses, solutions, curves and order of a tour, 8 hexadecimal digits.

    It does not change while the tour is visited.
    """
    digest = hashlib.sha256(repr((tour.order, tour.reference_every)).encode())
    for split, plan in sorted(tour.plans.items()):
        digest.update(f'{split} {len(plan.poses)} '.encode())
        for pose in plan.poses:
            digest.update(f'{pose.solutions.shape} {pose.correction}'.encode())
            digest.update(np.ascontiguousarray(pose.solutions).tobytes())
            if pose.way is not None:
                digest.update(f'{pose.way.points.shape}'.encode())
                digest.update(np.ascontiguousarray(pose.way.points).tobytes())
                digest.update(np.ascontiguousarray(pose.way.shares).tobytes())
    return digest.hexdigest()[:8]


def service_name(plan: str) -> str:
    """Return the name below /remaster/confirm of the service that confirms only this plan."""
    return f'plan_{plan}'


class PlanConfirmation:
    """The plan that is shown, and the one that was confirmed.

    Parameters
    ----------
    required
        Whether the arm waits for a confirmation; otherwise every plan may be followed.
    page
        Path of the page with the plan, for messages.

    Attributes
    ----------
    required
        As given.
    shown
        Fingerprint of the plan on the page; '' if there is none.
    confirmed
        Fingerprint of the confirmed plan; '' for none.
    trouble
        Why the next plan cannot be shown; ''.
    """

    def __init__(self, required: bool, page: str) -> None:
        self.required, self._page = required, page
        self.shown = self.confirmed = self.trouble = ''
        # Plans shown and never confirmed: a person may still look at one of them.
        self._pending: set[str] = set()

    def withdraw(self) -> None:
        """Mark the page as outdated, as another plan is next; `confirmed` stays."""
        self.shown = self.trouble = ''

    def show(self, plan: str) -> None:
        """Note that the page shows the plan with this fingerprint."""
        self.shown, self.trouble = plan, ''
        if plan != self.confirmed:
            self._pending.add(plan)

    def allows(self, tour: Tour | None) -> bool:
        """Whether the arm may follow a tour: its plan is confirmed, or that is not required.

        False for None if it is required.
        """
        if not self.required:
            return True
        return tour is not None and self.confirmed == fingerprint(tour)

    def refusal(self) -> str:
        """Return why the arm may not move, and what to do; '' if it may."""
        if not self.required:
            return ''
        if self.trouble:
            return f'the plan cannot be shown: {self.trouble}'
        if not self.shown:
            return (
                f'the plan is not confirmed; it is being drawn: look at {self._page} when it is '
                f'there, then call {CONFIRM} and {COLLECT}'
            )
        if self.shown != self.confirmed:
            return (
                f'plan {self.shown} is not confirmed: look at {self._page}, then call {CONFIRM} '
                f'and {COLLECT}'
            )
        return ''

    def confirm(self, plan: str = '') -> tuple[bool, str]:
        """Confirm the plan that is shown; return whether that succeeded, and the answer.

        ``plan``: fingerprint of the plan that the person has seen; another one than the plan
        on the page is refused, however late the request comes. '' for the plan on the page:
        refused if the page has shown another, unconfirmed plan since the last confirmation,
        which the person may mean. Refused as well if no plan is shown, or none has to be
        confirmed.
        """
        if not self.required:
            return False, 'no plan waits for that; confirm: true in the cell file asks for it'
        if plan and plan != self.shown:
            return False, f'plan {plan} is not the one that is next; {self.refusal()}'.rstrip('; ')
        if not self.shown:
            return False, self.refusal()
        if not plan and self._pending - {self.shown}:
            return False, (
                f'plan {self.shown} has taken the place of another one: look at {self._page} '
                f'again, then call {CONFIRM}/{service_name(self.shown)} and {COLLECT}'
            )
        self.confirmed = self.shown
        self._pending.clear()
        return True, f'plan {self.shown} is confirmed; {COLLECT} begins or goes on'

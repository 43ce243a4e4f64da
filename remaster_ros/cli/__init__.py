# SPDX-License-Identifier: Apache-2.0
"""The ``remaster`` command: one file per verb."""

from remaster_ros.requirements import end_without_packages

# Before a verb imports one of them.
end_without_packages()

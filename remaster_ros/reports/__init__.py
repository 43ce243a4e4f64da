# SPDX-License-Identifier: Apache-2.0
"""fit.json and discovery.json, figures and pages."""

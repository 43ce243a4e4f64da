# SPDX-License-Identifier: Apache-2.0
"""The result in the form in which a controller or a program takes it."""

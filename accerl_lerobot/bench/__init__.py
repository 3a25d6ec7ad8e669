# SPDX-License-Identifier: Apache-2.0
"""Every performance claim as a command."""

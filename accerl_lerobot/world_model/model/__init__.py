# SPDX-License-Identifier: Apache-2.0
"""World models: their interface, our own class, and loading and saving."""

# SPDX-License-Identifier: Apache-2.0
"""A bounded store of segments between collecting and learning, and the pace at which both sides may go."""

# SPDX-License-Identifier: Apache-2.0
"""Messages between workers over sockets, and weights through Ray's object store."""

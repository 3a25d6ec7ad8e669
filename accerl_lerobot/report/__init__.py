# SPDX-License-Identifier: Apache-2.0
"""One page per run, to look at: what became of it, in one HTML file that needs nothing else.

`read.py` turns a run's folder into plain data, `run_page.py`, `world_model_page.py` and `comparison.py` say
what stands on a page in terms of `blocks.py`, `charts.py` draws, and `page.py` writes the file. Only the last
and the first touch the disk. Free of torch.
"""

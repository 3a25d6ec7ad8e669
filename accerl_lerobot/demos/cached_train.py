# SPDX-License-Identifier: Apache-2.0
"""`guarded_train` with the dataset's items kept in memory; same arguments, same items, same result.

LeRobot 0.6.1 decodes every image of an action chunk to read the chunk's actions: 3.8 ms an item for a chunk
of ten 64-pixel frames, several times what a tiny policy needs to learn from it. Items are remembered after
their first read.

Run: ``python -m accerl_lerobot.demos.cached_train <lerobot-train arguments>``
"""

from __future__ import annotations

from typing import Any

from torch.utils.data import Dataset

MAX_BYTES = 4 * 1024**3
"""Datasets that would take more memory than this as float images are read the stock way."""


class CachedDataset(Dataset[Any]):
    """A map-style LeRobotDataset whose items are remembered; everything else is the dataset's own.

    Only for datasets without random image transforms, which must differ from epoch to epoch.
    """

    def __init__(self, dataset: Any) -> None:
        self._dataset = dataset
        self._items: dict[int, dict[str, Any]] = {}

    def __len__(self) -> int:
        return len(self._dataset)

    def __getitem__(self, index: int) -> dict[str, Any]:
        item = self._items.get(index)
        if item is None:
            item = self._items[index] = self._dataset[index]
        return dict(item)

    def __getattr__(self, name: str) -> Any:
        if name == "_dataset":  # not there yet while a loader process unpickles this object
            raise AttributeError(name)
        return getattr(self._dataset, name)


def item_bytes(meta: Any) -> int:
    """Memory of one item's images, as float32."""
    total = 0
    for key in meta.camera_keys:
        size = 4
        for side in meta.features[key]["shape"]:
            size *= side
        total += size
    return total


def main() -> None:
    """Runs ``lerobot-train`` on the command line's arguments."""
    from lerobot.scripts import lerobot_train

    from accerl_lerobot.demos import guarded_train

    stock = lerobot_train.make_train_eval_datasets

    def cached(cfg: Any) -> tuple[Any, Any]:
        train, evaluation = stock(cfg)
        fixed = not cfg.dataset.image_transforms.enable and not cfg.dataset.streaming
        size = item_bytes(train.meta) * cfg.policy.n_obs_steps
        if fixed and len(train) * size <= MAX_BYTES:
            train = CachedDataset(train)
        return train, evaluation

    lerobot_train.make_train_eval_datasets = cached
    guarded_train.main()


if __name__ == "__main__":
    main()

"""Writes new.pth and old.pth: two tensors as torch.save has written them since 1.6 and before, without torch.

The layout is that of torch/serialization.py (`_save` and `_legacy_save`); stand-ins with the names of torch's own classes
and functions make Python's pickle write the same operations.
"""

import array
import io
import pickle
import struct
import sys
import types
import zipfile
from collections import OrderedDict
from pathlib import Path

FOLDER = Path(__file__).parent


class FloatStorage:
    def __init__(self, key, values):
        self.key, self.values = key, array.array("f", values)


class HalfStorage(FloatStorage):
    pass


def _rebuild_tensor_v2(*arguments):
    raise NotImplementedError


torch, utils = types.ModuleType("torch"), types.ModuleType("torch._utils")
for kind in (FloatStorage, HalfStorage):
    kind.__module__ = "torch"
    setattr(torch, kind.__name__, kind)
_rebuild_tensor_v2.__module__ = "torch._utils"
utils._rebuild_tensor_v2 = _rebuild_tensor_v2
torch._utils = utils
sys.modules.update({"torch": torch, "torch._utils": utils})


class Tensor:
    def __init__(self, storage, offset, size, stride):
        self.arguments = (storage, offset, size, stride, False, OrderedDict())

    def __reduce_ex__(self, protocol):
        return (_rebuild_tensor_v2, self.arguments)


shared = FloatStorage("0", [9.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
weights = OrderedDict(
    [
        ("features.0.weight", Tensor(shared, 1, (2, 3), (3, 1))),
        ("features.0.bias", Tensor(FloatStorage("1", [-0.5, 0.25]), 0, (2,), (1,))),
    ]
)
weights._metadata = OrderedDict([("", {"version": 1})])


class Pickler(pickle.Pickler):
    def __init__(self, file, legacy):
        super().__init__(file, protocol=2)
        self.legacy, self.storages = legacy, {}

    def persistent_id(self, thing):
        if not isinstance(thing, FloatStorage):
            return None
        self.storages[thing.key] = thing
        reference = ("storage", type(thing), thing.key, "cpu", len(thing.values))
        return reference + (None,) if self.legacy else reference


def pickled(legacy):
    file = io.BytesIO()
    pickler = Pickler(file, legacy)
    pickler.dump(weights)
    return file.getvalue(), pickler.storages


content, storages = pickled(legacy=False)
with zipfile.ZipFile(FOLDER / "new.pth", "w", zipfile.ZIP_STORED) as archive:
    def add(name, data):
        archive.writestr(zipfile.ZipInfo(f"weights/{name}", (1980, 1, 1, 0, 0, 0)), data)

    add("data.pkl", content)
    add("byteorder", b"little")
    for key, storage in storages.items():
        add(f"data/{key}", storage.values.tobytes())
    add("version", b"3\n")

content, storages = pickled(legacy=True)
with open(FOLDER / "old.pth", "wb") as file:
    pickle.dump(0x1950A86A20F9469CFC6C, file, protocol=2)
    pickle.dump(1001, file, protocol=2)
    sizes = {"short": 2, "int": 4, "long": 4}
    pickle.dump({"protocol_version": 1001, "little_endian": True, "type_sizes": sizes}, file, protocol=2)
    file.write(content)
    pickle.dump(sorted(storages), file, protocol=2)
    for key in sorted(storages):
        file.write(struct.pack("<q", len(storages[key].values)) + storages[key].values.tobytes())

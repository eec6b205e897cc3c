"""A device that is not there: CPU tensors that pretend to be on it, and may not meet those that do not.

`FakeTensorMode` would not do: its tensors have no values, on which `.item()`, masks and checkpoints depend, and a build
of torch without CUDA has no CUDA generator.

As on a real GPU, a scalar of the CPU may take part in a pointwise operation, and indices of the CPU choose from any
tensor. What the compiler makes is not seen, nor whether a device has a kernel for each operation.
"""

from contextlib import contextmanager

import pytest
import torch
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

CPU = torch.device("cpu")
ANY_DEVICES = {"copy_", "_to_copy"}
INDEXING = {"index", "index_put", "index_put_", "_index_put_impl_", "_unsafe_index", "_unsafe_index_put"}
SCALARS = {"index_put", "index_put_", "_index_put_impl_", "fill_", "masked_fill", "masked_fill_"}
"""operations that are not pointwise, and yet take a scalar of the CPU among tensors of another device"""


def whole(device):
    """`cuda` names the first GPU."""
    device = torch.device(device)
    return device if device.index is not None or device == CPU else torch.device(device.type, 0)


def tensors_in(value):
    if isinstance(value, torch.Tensor):
        return [value]
    if isinstance(value, dict):
        value = value.values()
    elif not isinstance(value, tuple | list):
        return []
    return [tensor for part in value for tensor in tensors_in(part)]


class Generator(torch.Generator):
    """Draws the CPU's numbers on any device."""

    def __new__(cls, device="cpu"):
        self = super().__new__(cls)
        self._device = whole(device)
        return self

    def __init__(self, device="cpu"):
        super().__init__()

    @property
    def device(self):
        return self._device


class Devices:
    """The pretended device of each memory. Those known are kept, so that no other tensor gets their address."""

    def __init__(self):
        self._known = {}
        self.of_call = CPU
        """of the tensors that the present call was given"""

    def of(self, tensor):
        return self._known.get(self._memory(tensor)._cdata, (CPU, None))[0]

    def put(self, tensor, device):
        memory = self._memory(tensor)
        if device == CPU:
            self._known.pop(memory._cdata, None)
        else:
            self._known[memory._cdata] = device, memory
        return tensor

    def _memory(self, tensor):
        while torch._C._functorch.is_functorch_wrapped_tensor(tensor):
            tensor = torch._C._functorch.get_unwrapped(tensor)
        return tensor.untyped_storage()


class Operations(TorchDispatchMode):
    """Checks every operation, also those inside of derivatives, and puts its results on the device of its inputs."""

    def __init__(self, devices):
        super().__init__()
        self._devices = devices

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        inputs = tensors_in((args, kwargs))
        device = self._common(func, args, inputs)
        result = func(*args, **(kwargs or {}))
        memories = {tensor.untyped_storage()._cdata for tensor in inputs}
        for output in tensors_in(result):
            if output.untyped_storage()._cdata not in memories:
                self._devices.put(output, device)
        return result

    def _common(self, func, args, inputs):
        name, of = func.overloadpacket.__name__, self._devices.of
        if name in ANY_DEVICES:
            return of(inputs[0])
        if name in INDEXING:
            free = [tensor for tensor in tensors_in(args[1]) if of(tensor) == CPU]
            inputs = [tensor for tensor in inputs if not any(tensor is index for index in free)]
        if torch.Tag.pointwise in func.tags or func.namespace == "prims" or name in SCALARS:
            inputs = [tensor for tensor in inputs if tensor.dim() or of(tensor) != CPU]
        found = {of(tensor) for tensor in inputs}
        if len(found) > 1:
            raise RuntimeError(f"{func}: tensors on {' and '.join(sorted(map(str, found)))}")
        return found.pop() if found else self._devices.of_call  # such as the zero derivatives that torch makes itself


class Calls(TorchFunctionMode):
    """Answers what a tensor is asked of its device, and takes `device` out of the calls that make or move tensors."""

    def __init__(self, devices):
        super().__init__()
        self._devices = devices

    def __torch_function__(self, func, types, args=(), kwargs=None):
        result = self._call(func, args, dict(kwargs or {}))
        for tensor in tensors_in(result):
            if tensor.dtype == torch.float64 and self._devices.of(tensor).type == "mps":
                raise TypeError(f"{func}: mps has no float64")
        return result

    def _call(self, func, args, kwargs):
        of = self._devices.of
        if func == torch.Tensor.device.__get__:
            return of(args[0])
        if func in (torch.Tensor.is_cuda.__get__, torch.Tensor.is_cpu.__get__):
            return of(args[0]).type == ("cuda" if func == torch.Tensor.is_cuda.__get__ else "cpu")
        if func is torch.Tensor.numpy and of(args[0]) != CPU:
            raise TypeError(f"a tensor on {of(args[0])} has no array")
        if func in (torch.Tensor.to, torch.Tensor.cpu):
            return self._move(func, args, kwargs)
        device = kwargs.pop("device", None)
        if func is torch.Tensor.new_tensor and device is None:
            device = of(args[0])
        if device is not None:
            device = whole(device)
        if generator := kwargs.get("generator"):
            drawn_on = device or next(map(of, tensors_in(args)), CPU)
            if generator.device != drawn_on:
                raise RuntimeError(f"{func}: a generator of {generator.device} for a tensor on {drawn_on}")
        self._devices.of_call = next((of(tensor) for tensor in tensors_in((args, kwargs)) if of(tensor) != CPU), CPU)
        try:
            result = func(*args, **kwargs)
        finally:
            self._devices.of_call = CPU
        return result if device is None else self._devices.put(result, device)

    def _move(self, func, args, kwargs):
        tensor, *rest = args
        before = after = self._devices.of(tensor)
        rest += [value for name, value in kwargs.items() if name in ("device", "dtype", "other")]
        dtypes = [value for value in rest if isinstance(value, torch.dtype)]
        for value in rest:
            if isinstance(value, torch.device | str):
                after = whole(value)
            elif isinstance(value, torch.Tensor):
                after, dtypes = self._devices.of(value), [value.dtype]
        if func is torch.Tensor.cpu:
            after = CPU
        result = tensor.to(dtypes[0]) if dtypes else tensor
        if after != before:
            result = self._devices.put(result.clone() if result.data_ptr() == tensor.data_ptr() else result, after)
        return result


@contextmanager
def pretend():
    """Inside, two GPUs and Apple's are there, with the CPU's numbers."""
    devices = Devices()
    with pytest.MonkeyPatch.context() as patch, Operations(devices), Calls(devices):
        patch.setattr(torch, "Generator", Generator)
        patch.setattr(torch.cuda, "is_available", lambda: True)
        patch.setattr(torch.cuda, "device_count", lambda: 2)
        patch.setattr(torch.cuda, "mem_get_info", lambda device: (2**30, 2**30))
        patch.setattr(torch.backends.mps, "is_available", lambda: True)
        yield

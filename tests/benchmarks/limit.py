"""The least time that an update takes on this machine: its matrix products, and its numbers once through the memory."""

from collections import Counter
from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode

from rllib_maobs.replay import Batch
from tests.benchmarks.internals import eager_gradients_of, number_of_parameters
from tests.benchmarks.measure import best

# Matrix products, and which of their arguments are the factors.
PRODUCTS = {
    torch.ops.aten.mm: (0, 1),
    torch.ops.aten.bmm: (0, 1),
    torch.ops.aten.addmm: (1, 2),
    torch.ops.aten.baddbmm: (1, 2),
}


class Products(TorchDispatchMode):
    """Counts the matrix products that are made, by the shapes and strides of their factors."""

    def __init__(self) -> None:
        super().__init__()
        self.count: Counter[tuple[Any, ...]] = Counter()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        """Counts one."""
        if func.overloadpacket in PRODUCTS:
            factors = [args[i] for i in PRODUCTS[func.overloadpacket]]
            self.count[tuple((tuple(f.shape), f.stride()) for f in factors)] += 1
        return func(*args, **(kwargs or {}))


def like(shape: tuple[int, ...], strides: tuple[int, ...]) -> torch.Tensor:
    """A tensor that lies in memory as another one did."""
    extent = 1 + sum((size - 1) * stride for size, stride in zip(shape, strides, strict=True))
    return torch.randn(extent).as_strided(shape, strides)


def limit(learner: Any, batch: Batch) -> float:
    """Least seconds of an update here: its matrix products, then all its numbers once through the memory."""
    work = eager_gradients_of(learner, batch)
    with torch.no_grad(), Products() as products:
        work()
    seconds = 0.0
    for shapes, count in products.count.items():
        a, b = (like(*shape) for shape in shapes)
        out = torch.matmul(a, b)
        seconds += count * best(lambda a=a, b=b, out=out: torch.matmul(a, b, out=out), 0.05)
    numbers = number_of_parameters(learner)
    x, y = torch.zeros(numbers), torch.ones(numbers)
    bandwidth = 12 * numbers / best(lambda: x.add_(y), 0.1)  # reads two, writes one
    # Parameter, target and Adam's two means are read and written, the gradient is read.
    return seconds + 4 * 9 * numbers / bandwidth

"""The translation of a module into a list of operations, through torch.export.

Whatever does not depend on the observation (weights, their types and layouts, the normalizer's standard deviation) is
computed here, once.
"""

import operator
import warnings
from typing import Any

import torch
from torch import nn
from torch.export.graph_signature import InputKind
from torch.fx.node import Node, map_arg
from torch.utils import _pytree as pytree

from lemniscate.errors import UserError
from lemniscate.exporting.calls import BATCH, Call, UntranslatableError
from lemniscate.exporting.operations import Operation, Program, Value
from lemniscate.exporting.translations import TRANSLATIONS

KEPT = (torch.ops.aten.linear.default, torch.ops.aten.layer_norm.default, torch.ops.aten.silu.default)
"""taken as they are, where others are split into simpler ones"""
CHECKS = ("_assert_tensor_metadata", "_assert_scalar", "sym_constrain_range_for_size")
"""have no result"""
KNOWN = {*TRANSLATIONS, *CHECKS}


def translate(module: nn.Module, inputs: int) -> Program:
    """The operations of a module from [B, inputs] to [B, …], for any B.

    Raises:
        UserError: an operation that has no translation, or a result that depends on more than one row.
    """
    try:
        return _Translator(_exported(module, inputs)).program()
    except UntranslatableError as error:
        raise UserError(f"This network cannot be exported: {error}.") from None


def _exported(module: nn.Module, inputs: int) -> torch.export.ExportedProgram:
    batch = {0: torch.export.Dim("batch", min=2)}
    table = torch.export.default_decompositions()
    for operation in KEPT:
        table.pop(operation, None)
    try:
        with warnings.catch_warnings(), torch.no_grad():
            warnings.simplefilter("ignore")  # torch's own, about its own parts
            exported = torch.export.export(module, (torch.zeros(3, inputs),), dynamic_shapes=(batch,))
            is_known = {_name_of(node) for node in exported.graph.nodes if node.op == "call_function"} <= KNOWN
            return exported if is_known else exported.run_decompositions(table)
    except Exception as error:  # whatever the code of a user's own network, or its tracing, raises
        if "Constraints violated" in str(error):
            raise UntranslatableError("it is made for one number of observations") from error
        lines = [line.strip() for line in str(error).splitlines() if line.strip()]
        raise UntranslatableError((lines or [type(error).__name__])[0].rstrip(".:")) from error


def _name_of(node: Node) -> str:
    """The name of torch's operation without its overload; one that works in place ends in an underscore."""
    parts = str(node.target).split(".")
    return "getitem" if node.target is operator.getitem else parts[min(1, len(parts) - 1)]


def _needed(operations: list[Operation], action: Value) -> tuple[Operation, ...]:
    """The operations that the action depends on, in their order: the mode needs no standard deviation, say."""
    values, kept = {action}, list[Operation]()
    for operation in reversed(operations):
        if operation.output in values:
            values.update(operand for operand in operation.inputs if isinstance(operand, Value))
            kept.append(operation)
    return tuple(reversed(kept))


class _Translator:
    """A walk through a graph, node by node."""

    def __init__(self, exported: torch.export.ExportedProgram) -> None:
        self.exported = exported
        self.operations: list[Operation] = []
        self.results: dict[Node, Any] = {}
        self.obs, self.batch = Value("obs", ()), ""

    def program(self) -> Program:
        """All operations."""
        specs = {spec.arg.name: spec for spec in self.exported.graph_signature.input_specs}
        for node in self.exported.graph.nodes:
            if node.op == "placeholder":
                self.results[node] = self._placeholder(node, specs[node.name])
            elif node.op == "call_function":
                self.results[node] = self._call(node)
        (node,) = [node for node in self.exported.graph.nodes if node.op == "output"]
        action = self.results[node.args[0][0]]
        if not isinstance(action, Value):
            raise UntranslatableError("its actions do not depend on the observation")
        return Program(self.obs, _needed(self.operations, action), action)

    def _placeholder(self, node: Node, spec: Any) -> Any:
        if spec.kind is InputKind.USER_INPUT:
            batch, *shape = node.meta["val"].shape
            self.obs, self.batch = Value("obs", tuple(shape)), str(batch)
            return self.obs
        return {**self.exported.state_dict, **self.exported.constants}.get(spec.target)

    def _call(self, node: Node) -> Any:
        name = _name_of(node)
        if name in CHECKS:
            return None
        args, kwargs = map_arg((node.args, node.kwargs), self.results.__getitem__)
        given = pytree.tree_leaves((args, kwargs))
        if not any(isinstance(leaf, Value) or leaf is BATCH for leaf in given):
            assert callable(node.target)
            return node.target(*args, **kwargs)
        if getattr(node.target, "__module__", "") == "_operator" and BATCH in given:  # on its way into a shape
            return BATCH
        if name not in TRANSLATIONS:
            raise UntranslatableError(f"{name} has no translation")
        return TRANSLATIONS[name](Call(self.operations, node.meta["val"], name, self.batch), *args, **kwargs)

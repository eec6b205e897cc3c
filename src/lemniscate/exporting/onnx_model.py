"""ONNX from a list of operations, and onnxruntime, which acts with it."""

import json
from collections.abc import Mapping
from typing import Any

import numpy as np

from lemniscate.exporting.deployed import Act, as_rows
from lemniscate.exporting.translation import Operand, Operation, Program, Value
from lemniscate.system.machine import version

OPSET, IR = 18, 10
"""of 2022 and 2024, so that runtimes that are some years old can read the model"""


def onnx_model(program: Program, facts: Mapping[str, Any]) -> bytes:
    """A model with the input `obs` [batch, O] float32 and the output `action` [batch, …], checked.

    Of a policy with a memory it has the input `memory` [batch, K] too, zeros where an episode begins, and the output
    `next_memory`.

    Its metadata are the `facts`, each as JSON.
    """
    writer = _Writer()
    helper, checker = writer.onnx.helper, writer.onnx.checker
    for operation in program.operations:
        writer.add(operation)
    given = {"obs": program.obs} | ({"memory": program.memory} if program.memory else {})
    results = {"action": program.action} | ({"next_memory": program.after} if program.after else {})
    for name, value in results.items():
        writer.node("Identity", [value.name], name)
    inputs, outputs = (
        [helper.make_tensor_value_info(name, writer.types[v.kind], ["batch", *v.shape]) for name, v in values.items()]
        for values in (given, results)
    )
    graph = helper.make_graph(writer.nodes, "policy", inputs, outputs, initializer=writer.initializers)
    opset = helper.make_opsetid("", OPSET)
    model = helper.make_model(graph, opset_imports=[opset], ir_version=IR, producer_name="lemniscate")
    model.producer_version = version()
    helper.set_model_props(model, {name: json.dumps(value) for name, value in facts.items()})
    checker.check_model(model, full_check=True)
    return model.SerializeToString()


def onnx_act(model: bytes) -> tuple[Act, str]:
    """The policy in onnxruntime, on one thread, and the version of onnxruntime."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.log_severity_level = 3
    session = onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    inputs = session.get_inputs()
    ends = np.cumsum([given.shape[1] for given in inputs])[:-1]

    def act(obs: np.ndarray) -> np.ndarray:
        parts = zip(inputs, np.split(obs, ends, axis=1), strict=True)
        results = session.run(None, {given.name: part for given, part in parts})
        return np.hstack([as_rows(np.asarray(result)) for result in results])

    return act, onnxruntime.__version__


class _Writer:
    def __init__(self) -> None:
        import onnx

        self.onnx, number = onnx, onnx.TensorProto
        self.types = {"float": number.FLOAT, "int": number.INT64, "bool": number.BOOL}
        self.nodes: list[Any] = []
        self.initializers: list[Any] = []

    def node(self, name: str, inputs: list[str], output: str, **attributes: Any) -> str:
        """A new node; returns the name of its output."""
        self.nodes.append(self.onnx.helper.make_node(name, inputs, [output], **attributes))
        return output

    def operand(self, operand: Operand) -> str:
        """The name of a result or of a new constant."""
        if isinstance(operand, Value):
            return operand.name
        name = f"constant_{len(self.initializers)}"
        self.initializers.append(self.onnx.numpy_helper.from_array(np.ascontiguousarray(operand), name))
        return name

    def add(self, operation: Operation) -> None:
        """Translate one operation."""
        name, output = operation.name, operation.output.name
        if name == "Linear":
            self._linear(operation)
            return
        places, attributes = self._settings(operation)
        inputs = [self.operand(operand) for operand in (*operation.inputs, *map(np.array, places))]
        if name == "RoundBfloat16":
            rounded = self.node("Cast", inputs, f"{output}_bfloat16", to=self.onnx.TensorProto.BFLOAT16)
            self.node("Cast", [rounded], output, to=self.types["float"])
        else:
            self.node(name, inputs, output, **attributes)

    def _settings(self, operation: Operation) -> tuple[list[list[int]], dict[str, Any]]:
        """Further inputs of whole numbers, and attributes; here axes and shapes count the batch."""
        shape, settings = operation.output.shape, operation.settings
        match operation.name:
            case "Slice":
                start, end = settings["start"], settings["start"] + shape[settings["axis"]]
                return [[start], [end], [settings["axis"] + 1]], {}
            case "Reshape":
                return [[-1, *shape]], {}
            case "Expand":
                return [[1, *shape]], {}
            case "Transpose":
                return [], {"perm": [0, *(axis + 1 for axis in settings["axes"])]}
            case "Concat":
                return [], {"axis": settings["axis"] + 1}
            case "Cast":
                return [], {"to": self.types[operation.output.kind]}
            case "ArgMax":
                return [], {"axis": -1, "keepdims": 0}
        return ([[-1]], {"keepdims": 1}) if operation.name.startswith("Reduce") else ([], {})

    def _linear(self, operation: Operation) -> None:
        x, output = self.operand(operation.inputs[0]), operation.output.name
        biases = [self.operand(operand) for operand in operation.inputs[2:]]
        if len(operation.output.shape) == 1:  # Gemm takes matrices only, MatMul any number of axes
            self.node("Gemm", [x, self.operand(operation.weight), *biases], output, transB=1)
            return
        weight = self.operand(operation.weight.T)
        product = self.node("MatMul", [x, weight], f"{output}_product" if biases else output)
        if biases:
            self.node("Add", [product, *biases], output)

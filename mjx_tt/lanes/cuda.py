"""Loops as kernels on NVIDIA's accelerators: LLVM's text to PTX, by the driver to machine code, and XLA's call of it.

The driver is asked through its C interface, without CUDA's tools. Its names and constants: cuda.h.
"""

from __future__ import annotations

import ctypes
from functools import cache
from pathlib import Path

import jax

from mjx_tt.lanes import frame, kernel, machine
from mjx_tt.lanes.emitter import Unsupported
from mjx_tt.lanes.frame import Operand

PLATFORM = "CUDA"  # XLA's name
_TRIPLE, _NEWEST = "nvptx64-nvidia-cuda", 90  # of LLVM's architectures; PTX for an older one runs on newer ones
_MAJOR, _MINOR = 75, 76  # CU_DEVICE_ATTRIBUTE_COMPUTE_CAPABILITY_*
# Offsets in bytes, c_api.h: XLA_FFI_CallFrame's api and ctx, XLA_FFI_Api's functions, XLA_FFI_Error_Code_INTERNAL.
_API, _CONTEXT, _ERROR_CREATE, _STREAM_GET, _INTERNAL = 16, 24, 48, 80, 13


def present() -> bool:
    """True where JAX computes on an NVIDIA accelerator."""
    return jax.default_backend() == "gpu" and "cuda" in jax.devices()[0].client.platform_version.lower()


def compiled(loop: str, operands: list[Operand], lanes: int, folder: Path | None) -> ctypes.c_void_p:
    """The address of an XLA_FFI_Handler that starts the loop of ``kernel.module``. Raises Unsupported.

    folder: where PTX is kept.
    """
    built_for = f"{_TRIPLE} {_architecture()}"
    code = machine.kept(loop, built_for, ".ptx", folder, lambda: ptx(loop, operands, lanes, _architecture()))
    return machine.compiled(handler(operands, lanes, _loaded(code), _address("cuLaunchKernel")), "handler", None)


def ptx(loop: str, operands: list[Operand], lanes: int, architecture: str) -> bytes:
    """PTX of a loop, such as for "sm_90"."""
    text = loop.replace("define void @lane", "define internal void @lane") + kernel.entry(operands, lanes)
    return machine.assembly(text, _TRIPLE, architecture).encode()


def handler(operands: list[Operand], lanes: int, kernel_handle: int, launch: int) -> str:
    """LLVM's text of the function that XLA calls: it starts the kernel in XLA's stream and does not wait."""
    arguments = [f"a{i}" for i in range(len(operands))]
    arguments += [f"r{i}" for i, o in enumerate(operands) if o.kind == "state"]
    n = len(arguments)
    lines = [
        # XLA_FFI_Stream_Get_Args: struct_size, extension_start, ctx, stream.
        "%asked_stream = alloca [4 x i64], align 8",
        f"%table = alloca [{n} x ptr], align 8",
        f"%values = alloca [{n} x ptr], align 8",
        "%error = alloca [4 x i64], align 8",
        *frame.opened(operands),
        *frame.field("api", "frame", _API),
        *frame.field("context", "frame", _CONTEXT),
        *frame.field("stream_get", "api", _STREAM_GET),
        *frame.field("error_create", "api", _ERROR_CREATE),
        "call void @llvm.memset.p0.i64(ptr %asked_stream, i8 0, i64 32, i1 false)",
        "store i64 32, ptr %asked_stream",
        "%context_to = getelementptr i8, ptr %asked_stream, i64 16",
        "store ptr %context, ptr %context_to",
        "%refused = call ptr %stream_get(ptr %asked_stream)",
        "%no_stream = icmp ne ptr %refused, null",
        "br i1 %no_stream, label %refusal, label %start",
        "refusal:",
        "ret ptr %refused",
        "start:",
        *frame.field("stream", "asked_stream", 24),
    ]
    for i, name in enumerate(arguments):
        lines += [
            f"%value_{i} = getelementptr ptr, ptr %values, i64 {i}",
            f"store ptr %{name}, ptr %value_{i}",
            f"%row_{i} = getelementptr ptr, ptr %table, i64 {i}",
            f"store ptr %value_{i}, ptr %row_{i}",
        ]
    threads, _ = kernel.launch(lanes)
    grid = f"i32 {-(-lanes // threads)}, i32 1, i32 1, i32 {threads}, i32 1, i32 1, i32 0"
    lines += [
        f"%launch = inttoptr i64 {launch} to ptr",
        f"%kernel = inttoptr i64 {kernel_handle} to ptr",
        f"%status = call i32 %launch(ptr %kernel, {grid}, ptr %stream, ptr %table, ptr null)",
        "%failed = icmp ne i32 %status, 0",
        "br i1 %failed, label %failure, label %end",
        "failure:",
        # XLA_FFI_Error_Create_Args: struct_size, extension_start, message, errc.
        "call void @llvm.memset.p0.i64(ptr %error, i8 0, i64 32, i1 false)",
        "store i64 28, ptr %error",
        "%message_to = getelementptr i8, ptr %error, i64 16",
        "store ptr @message, ptr %message_to",
        "%code_to = getelementptr i8, ptr %error, i64 24",
        f"store i32 {_INTERNAL}, ptr %code_to",
        "%made = call ptr %error_create(ptr %error)",
        "ret ptr %made",
        "end:",
        "ret ptr null",
    ]
    said = "a loop's kernel did not start (cuLaunchKernel); task.lanes: false leaves loops to XLA"
    body = "\n".join(lines)
    return (
        f'@message = private constant [{len(said) + 1} x i8] c"{said}\\00"\n'
        f"define ptr @handler(ptr %frame) nounwind {{\n{body}\n}}\n"
    )


@cache
def _driver() -> ctypes.CDLL:
    try:
        return ctypes.CDLL("libcuda.so.1")
    except OSError as error:
        raise Unsupported(f"NVIDIA's driver: {error}") from error


def _address(function: str) -> int:
    return ctypes.cast(getattr(_driver(), function), ctypes.c_void_p).value or 0


def _ask(function: str, *arguments: object) -> None:
    try:
        status = getattr(_driver(), function)(*arguments)
    except AttributeError as error:
        raise Unsupported(f"NVIDIA's driver is older than CUDA 12: {error}") from error
    if status:
        raise Unsupported(f"NVIDIA's driver: {function} gave error {status}")


@cache
def _architecture() -> str:
    """Of the first device."""
    device, numbers = ctypes.c_int(), []
    _ask("cuInit", 0)
    _ask("cuDeviceGet", ctypes.byref(device), 0)
    for attribute in (_MAJOR, _MINOR):
        number = ctypes.c_int()
        _ask("cuDeviceGetAttribute", ctypes.byref(number), attribute, device)
        numbers.append(number.value)
    return f"sm_{min(10 * numbers[0] + numbers[1], _NEWEST)}"


def _loaded(code: bytes) -> int:
    """The handle of a kernel for every device: libraries belong to no context. Lives as long as the process."""
    library, found, none = ctypes.c_void_p(), ctypes.c_void_p(), ctypes.c_void_p()
    _ask("cuLibraryLoadData", ctypes.byref(library), code + b"\0", none, none, 0, none, none, 0)
    _ask("cuLibraryGetKernel", ctypes.byref(found), library, b"run")
    return found.value or 0

"""Protobuf messages of records of plain numbers: one definition, the record type, gives both.

The descriptor is built here, so that nothing has to be compiled. Fields are numbered in the order
in which the type has them.
"""

from __future__ import annotations

import typing
from collections.abc import Mapping
from functools import cache

import msgspec
from google.protobuf.descriptor_pb2 import DescriptorProto, FieldDescriptorProto, FileDescriptorProto
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message import Message
from google.protobuf.message_factory import GetMessageClass
from mcap_protobuf.schema import build_file_descriptor_set

from uavctl.data import Record

_PACKAGE = "uavctl"
_SCALARS: Mapping[object, FieldDescriptorProto.Type.ValueType] = {
    float: FieldDescriptorProto.TYPE_DOUBLE,
    int: FieldDescriptorProto.TYPE_INT64,
    bool: FieldDescriptorProto.TYPE_BOOL,
    str: FieldDescriptorProto.TYPE_STRING,
}


@cache
def message_class(kind: type[Record]) -> type[Message]:
    """Message type `uavctl.<name of the record>`.

    Args:
        kind: its fields are floats, integers, booleans, texts, tuples of one of these, and records of such fields.

    Raises:
        TypeError: a field has another type; names it.
    """
    file = FileDescriptorProto(name=f"{_PACKAGE}/{kind.__name__}.proto", package=_PACKAGE, syntax="proto3")
    _describe(file.message_type.add(), kind, f".{_PACKAGE}")
    pool = DescriptorPool()  # its own: what other libraries register has no say in these names
    pool.Add(file)
    return GetMessageClass(pool.FindMessageTypeByName(f"{_PACKAGE}.{kind.__name__}"))


def pack(record: Record) -> bytes:
    """A record as the message of its type.

    Raises:
        ValueError: an integer that does not fit 64 bits, or a text that is none.
        TypeError: a value that is not of its field's type.
    """
    return message_class(type(record))(**msgspec.to_builtins(record)).SerializeToString()


def schema_of(kind: type[Message]) -> bytes:
    """Descriptors of a message type and of all that it uses, as MCAP wants them."""
    return build_file_descriptor_set(kind).SerializeToString()


def _describe(message: DescriptorProto, kind: type[msgspec.Struct], scope: str) -> None:
    """Fill in a message type; types of its fields go inside it, so that no name is taken twice."""
    message.name = kind.__name__
    scope = f"{scope}.{message.name}"
    for number, field in enumerate(msgspec.structs.fields(kind), start=1):
        entry = message.field.add(name=field.name, number=number, label=FieldDescriptorProto.LABEL_OPTIONAL)
        part = field.type
        if typing.get_origin(part) is tuple:
            entry.label = FieldDescriptorProto.LABEL_REPEATED
            part = typing.get_args(part)[0]
        if part in _SCALARS:
            entry.type = _SCALARS[part]
        elif isinstance(part, type) and issubclass(part, msgspec.Struct):
            entry.type = FieldDescriptorProto.TYPE_MESSAGE
            entry.type_name = f"{scope}.{part.__name__}"
            if part.__name__ not in {nested.name for nested in message.nested_type}:
                _describe(message.nested_type.add(), part, scope)
        else:
            raise TypeError(f"{kind.__name__}.{field.name}: no protobuf field for {field.type}")

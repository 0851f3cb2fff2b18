"""The loops over messages that NumPy would do in many passes, compiled.

Fields lie unaligned and little-endian in a message, and every machine that numba knows is little-endian.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numba.core import cgutils, types
from numba.extending import intrinsic

from .codec import HALF, NARROWED, OCTET, PREFIX, SECOND, TIME, WORD

_SEQUENCE, _LOG, _PUBLISH = (PREFIX.fields[name][1] for name in ("sequence", "log", "publish"))  # type: ignore[index]

#: Without counting references to the arrays (_nrt): numba would do that, atomically, at every call.
OPTIONS: dict[str, Any] = {"cache": True, "nogil": True, "_nrt": False}


def _stores(typing, data, at, value):
    """Store ``value`` at byte ``at`` of ``data``, aligned or not."""

    def generate(context, builder, signature, arguments):
        array = context.make_array(signature.args[0])(context, builder, arguments[0])
        to = builder.gep(array.data, [arguments[1]])
        builder.store(arguments[2], builder.bitcast(to, arguments[2].type.as_pointer()), align=1)
        return context.get_dummy_value()

    return types.none(data, at, value), generate


def _loads(kind):
    """Return a function that loads a number of this type from an address, aligned or not."""

    def typed(typing, address):
        def generate(context, builder, signature, arguments):
            value = context.get_value_type(kind)
            return builder.load(builder.inttoptr(arguments[0], value.as_pointer()), align=1, typ=value)

        return kind(address), generate

    return intrinsic(typed)


def _copies(typing, data, at, source, size):
    """Copy ``size`` bytes of ``source`` to byte ``at`` of ``data``."""

    def generate(context, builder, signature, arguments):
        to, given = (
            context.make_array(signature.args[k])(context, builder, arguments[k]).data for k in (0, 2)
        )
        cgutils.raw_memcpy(builder, builder.gep(to, [arguments[1]]), given, arguments[3], 1)
        return context.get_dummy_value()

    return types.none(data, at, source, size), generate


_put: Any = intrinsic(_stores)
_copy: Any = intrinsic(_copies)
_word: Any = _loads(types.int64)
_half: Any = _loads(types.int32)
_octet: Any = _loads(types.uint8)
_double: Any = _loads(types.float64)


@numba.njit(**OPTIONS)
def lay(data, index, template, sequence, times, fields, ends, size, n):
    """Lay rows of columns into message records.

    Parameters
    ----------
    data : ndarray of uint8, shape (n * size or more,)
        Takes the records.
    index : ndarray of int64, shape (n or more, 2)
        Takes the entries of the message index: log time, and where the record starts in ``data``. The first
        entry says where the first record starts.
    template : ndarray of uint8, shape (size,)
        A record with all that is constant in it.
    sequence : int
        Sequence number of the first row.
    times : ndarray of int64, shape (2,)
        Addresses of the rows' log times and publish times (int64, contiguous).
    fields : ndarray of int64, shape (k, 3)
        Address and stride (bytes) of every column, and where its field lies in a record; sorted by kind.
    ends : ndarray of int64, shape (5,)
        Where in ``fields`` each kind ends, from :data:`WORD` to :data:`OCTET`.
    size : int
        Bytes of a record.
    n : int
        Rows.
    """
    first = index[0, 1]
    for i in range(n):
        record = first + i * size
        log, publish = _word(times[0] + 8 * i), _word(times[1] + 8 * i)
        index[i, 0] = log
        index[i, 1] = record
        _copy(data, record, template, size)
        _put(data, record + _SEQUENCE, np.int32(sequence + i))
        _put(data, record + _LOG, log)
        _put(data, record + _PUBLISH, publish)
        k = 0
        while k < ends[WORD]:
            _put(data, record + fields[k, 2], _word(fields[k, 0] + i * fields[k, 1]))
            k += 1
        while k < ends[NARROWED]:
            _put(data, record + fields[k, 2], np.float32(_double(fields[k, 0] + i * fields[k, 1])))
            k += 1
        while k < ends[HALF]:
            _put(data, record + fields[k, 2], _half(fields[k, 0] + i * fields[k, 1]))
            k += 1
        while k < ends[TIME]:
            value = _word(fields[k, 0] + i * fields[k, 1])
            seconds = value // SECOND
            _put(data, record + fields[k, 2], np.int32(seconds))
            _put(data, record + fields[k, 2] + 4, np.int32(value - seconds * SECOND))
            k += 1
        while k < ends[OCTET]:
            _put(data, record + fields[k, 2], _octet(fields[k, 0] + i * fields[k, 1]))
            k += 1

"""The loops over messages that NumPy would do in many passes, compiled.

Fields lie unaligned and little-endian in a message, and every machine that numba knows is little-endian.
"""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
from numba.core import cgutils, types
from numba.extending import intrinsic

from .codec import (
    HALF,
    NARROWED,
    PREFIX,
    SECOND,
    TIME,
    WORD,
)

_SEQUENCE, _LOG, _PUBLISH = (PREFIX.fields[name][1] for name in ("sequence", "log", "publish"))  # type: ignore[index]

#: Records that are encoded together, field by field: they stay in the processor's first cache meanwhile.
TOGETHER = 64

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


def _copies(typing, data, at, source, begin, size):
    """Copy ``size`` bytes of ``source``, from byte ``begin`` on, to byte ``at`` of ``data``."""

    def generate(context, builder, signature, arguments):
        to, given = (
            context.make_array(signature.args[k])(context, builder, arguments[k]).data for k in (0, 2)
        )
        to, given = builder.gep(to, [arguments[1]]), builder.gep(given, [arguments[3]])
        cgutils.raw_memcpy(builder, to, given, arguments[4], 1)
        return context.get_dummy_value()

    return types.none(data, at, source, begin, size), generate


_put: Any = intrinsic(_stores)
_copy: Any = intrinsic(_copies)
_word: Any = _loads(types.int64)
_half: Any = _loads(types.int32)
_octet: Any = _loads(types.uint8)
_double: Any = _loads(types.float64)


@numba.njit(**OPTIONS)
def encode_into(data, index, template, sequence, times, fields, ends, size, n):
    """Encode rows of columns into message records.

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
    begin, first = 0, index[0, 1]
    while begin < n:
        m = min(TOGETHER, n - begin)
        record = first + begin * size
        _copy(data, record, template, 0, size)
        done = 1
        while done < m:
            more = min(done, m - done)
            _copy(data, record + done * size, data, record, more * size)
            done += more
        log, publish = times[0] + 8 * begin, times[1] + 8 * begin
        for i in range(m):
            at = record + i * size
            index[begin + i, 0] = _word(log + 8 * i)
            index[begin + i, 1] = at
            _put(data, at + _SEQUENCE, np.int32(sequence + begin + i))
            _put(data, at + _LOG, _word(log + 8 * i))
            _put(data, at + _PUBLISH, _word(publish + 8 * i))
        for k in range(len(fields)):
            stride, at = fields[k, 1], record + fields[k, 2]
            source = fields[k, 0] + begin * stride
            if k < ends[WORD]:
                for i in range(m):
                    _put(data, at + i * size, _word(source + i * stride))
            elif k < ends[NARROWED]:
                for i in range(m):
                    _put(data, at + i * size, np.float32(_double(source + i * stride)))
            elif k < ends[HALF]:
                for i in range(m):
                    _put(data, at + i * size, _half(source + i * stride))
            elif k < ends[TIME]:
                for i in range(m):
                    value = _word(source + i * stride)
                    seconds = value // SECOND
                    _put(data, at + i * size, np.int32(seconds))
                    _put(data, at + i * size + 4, np.int32(value - seconds * SECOND))
            else:
                for i in range(m):
                    _put(data, at + i * size, _octet(source + i * stride))
        begin += m

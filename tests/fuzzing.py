"""Hypothesis strategies for malformed files: bytes that change anywhere, JSON with anything anywhere."""

from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

fuzz = settings(
    derandomize=True,  # the same cases at every run
    database=None,
    deadline=None,
    max_examples=150,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow, HealthCheck.data_too_large],
)


@st.composite
def damage(draw, longest=60):
    """A function that changes bytes: flips, cuts, repeats, insertions."""
    edits = draw(
        st.lists(
            st.tuples(
                st.sampled_from(["flip", "cut", "insert", "repeat", "drop"]),
                st.integers(0, 2**32),
                st.binary(min_size=1, max_size=longest)
                | st.sampled_from(
                    [b"\x00", b"nan", b"-", b"1e999", b'"', b"\xff\xfe", b"{" * 2000, "½é\ud7ff".encode()]
                ),
            ),
            min_size=1,
            max_size=4,
        )
    )

    def apply(data):
        for kind, where, extra in edits:
            at = where % (len(data) + 1)
            if kind == "flip" and at < len(data):
                data = data[:at] + bytes([data[at] ^ (extra[0] or 1)]) + data[at + 1 :]
            elif kind == "cut":
                data = data[:at]
            elif kind == "insert":
                data = data[:at] + extra + data[at:]
            elif kind == "repeat":
                data = data[:at] + data[at : at + 40] + data[at:]
            elif kind == "drop":
                data = data[:at] + data[at + len(extra) :]
        return data

    return apply


def nested(depth):
    value: object = []
    for _ in range(depth):
        value = [value]
    return value


strange = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-(2**70), 2**70),
    st.floats(allow_nan=True),
    st.text(max_size=4),
    st.sampled_from(
        [10**400, [], {}, [[]], "1", "9" * 30, "\ud800\n", nested(300), [1.0] * 10, [None] * 9, -0.0, 1e308]
    ),
)


def places(value, path=()):
    """The path of every value inside, the whole first."""
    yield path
    inside = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, item in inside:
        yield from places(item, (*path, key))


def replaced(content, which, new, rename):
    """JSON with one value, or one key, exchanged."""
    path = list(places(content))
    chosen = path[which % len(path)]
    if not chosen:
        return new
    holder = content
    for key in chosen[:-1]:
        holder = holder[key]
    if rename and isinstance(holder, dict):
        holder[str(new)[:30]] = holder.pop(chosen[-1])
    else:
        holder[chosen[-1]] = new
    return content


def one_line(error):
    text = str(error)
    assert text
    assert "\n" not in text
    assert len(text) < 1200

"""The run-time type check of jaxtyping's annotations under test: an int is accepted where a float is asked for."""

from beartype import BeartypeConf, beartype

checked = beartype(conf=BeartypeConf(is_pep484_tower=True))

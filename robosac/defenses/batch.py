"""What a defence yields where it knows what it will ask for next."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence

from robosac.defenses.protocol import Hypothesis


class Batch(tuple[Hypothesis, ...]):
    """Hypotheses to be tested, with others that are likely to be asked for after them: ``Batch(asked, offered)``.

    Where several are decoded at once, the others are decoded too, as far as there is room. No outcome depends on it.
    """

    offered: Callable[[], Iterable[Hypothesis]]
    """Gives the others, the likeliest first. It is called, if at all, before outcomes are sent, perhaps several times.
    It must change nothing: what it draws comes from a copy of the generator.
    """

    def __new__(cls, asked: Iterable[Hypothesis], offered: Callable[[], Iterable[Hypothesis]]) -> Batch:
        batch = super().__new__(cls, asked)
        batch.offered = offered
        return batch


def likely_after(batch: Sequence[Hypothesis], index: int) -> Iterator[Hypothesis]:
    """What is asked for from a hypothesis of a batch on, and then what is offered with it."""
    yield from batch[index:]
    if isinstance(batch, Batch):
        yield from batch.offered()

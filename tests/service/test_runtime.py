import gc

from tests.service.conftest import serve


async def test_a_search_for_garbage_does_not_look_through_what_was_loaded_before():
    async with serve():
        assert gc.get_freeze_count() > 100_000  # torch alone has more

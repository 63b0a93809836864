"""One thread of BLAS within, as many as before afterwards."""

import pytest
import threadpoolctl

from jaxhom.solvers.blas_threads import one_blas_thread


def threads():
    return [library["num_threads"] for library in threadpoolctl.threadpool_info() if library["user_api"] == "blas"]


@pytest.fixture(autouse=True)
def _two():
    with threadpoolctl.threadpool_limits(limits=2, user_api="blas"):
        yield


def test_within_and_after():
    with one_blas_thread():
        assert set(threads()) == {1}
        with one_blas_thread():
            assert set(threads()) == {1}
        assert set(threads()) == {1}
    assert set(threads()) == {2}


def test_after_an_error():
    with pytest.raises(KeyError), one_blas_thread():
        raise KeyError
    assert set(threads()) == {2}

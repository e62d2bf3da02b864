"""Resources with two faces: what is written once as steps can be called and can be awaited."""

import functools
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator
from dataclasses import replace
from typing import Any, Concatenate, Generic, ParamSpec, Self, TypeVar, overload

from fewview.api.drivers import Awaiting, Blocking
from fewview.api.forms import Page
from fewview.api.retries import call
from fewview.api.steps import Request, Steps

P = ParamSpec("P")
T = TypeVar("T")
Driver = TypeVar("Driver", bound=Blocking | Awaiting)


class Resource(Generic[Driver]):
    """What one part of the API can do, for the client whose driver it has."""

    def __init__(self, driver: Driver) -> None:
        self._driver = driver
        self._patience = driver.patience

    def _call(self, request: Request[T]) -> Steps[T]:
        return call(request, self._patience)


class operation(Generic[P, T]):  # noqa: N801
    """Makes of a method that returns steps one that returns their result, or is awaited for it."""

    def __init__(self, steps: Callable[Concatenate[Any, P], Steps[T]]) -> None:
        self.steps = steps
        self.__doc__ = steps.__doc__

    @overload
    def __get__(self, resource: None, owner: object) -> Self: ...
    @overload
    def __get__(self, resource: Resource[Blocking], owner: object) -> Callable[P, T]: ...
    @overload
    def __get__(
        self, resource: Resource[Awaiting], owner: object
    ) -> Callable[P, Coroutine[Any, Any, T]]: ...
    def __get__(self, resource: Any, owner: object) -> Any:
        if resource is None:
            return self
        bound = self.steps.__get__(resource)
        driver = resource._driver

        if isinstance(driver, Blocking):

            @functools.wraps(bound)
            def run(*args: P.args, **kwargs: P.kwargs) -> T:
                result: T = driver.run(bound(*args, **kwargs))
                return result

            return run

        @functools.wraps(bound)
        async def wait(*args: P.args, **kwargs: P.kwargs) -> T:
            result: T = await driver.run(bound(*args, **kwargs))
            return result

        return wait


class listing(Generic[P, T]):  # noqa: N801
    """Makes of a method that asks for the first page one that iterates over the items of all."""

    def __init__(self, first: Callable[Concatenate[Any, P], Request[Page[T]]]) -> None:
        self.first = first
        self.__doc__ = first.__doc__

    @overload
    def __get__(self, resource: None, owner: object) -> Self: ...
    @overload
    def __get__(self, resource: Resource[Blocking], owner: object) -> Callable[P, Iterator[T]]: ...
    @overload
    def __get__(
        self, resource: Resource[Awaiting], owner: object
    ) -> Callable[P, AsyncIterator[T]]: ...
    def __get__(self, resource: Any, owner: object) -> Any:
        if resource is None:
            return self
        bound = self.first.__get__(resource)
        iterate = _iterate if isinstance(resource._driver, Blocking) else _iterate_async

        @functools.wraps(bound)
        def run(*args: P.args, **kwargs: P.kwargs) -> Any:
            return iterate(resource, bound(*args, **kwargs))

        return run


def _iterate(resource: Resource[Blocking], request: Request[Page[T]] | None) -> Iterator[T]:
    while request is not None:
        page = resource._driver.run(resource._call(request))
        yield from page.items
        request = _following(request, page)


async def _iterate_async(
    resource: Resource[Awaiting], request: Request[Page[T]] | None
) -> AsyncIterator[T]:
    while request is not None:
        page = await resource._driver.run(resource._call(request))
        for item in page.items:
            yield item
        request = _following(request, page)


def _following(request: Request[Page[T]], page: Page[T]) -> Request[Page[T]] | None:
    if page.cursor is None:
        return None
    return replace(request, params={**request.params, "cursor": page.cursor})

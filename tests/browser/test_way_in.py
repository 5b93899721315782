"""The way in: keys, codes, and what the page says before there is anything to see."""

import pytest

from tests.browser.conftest import add_person, call, scan


def test_a_wrong_key_is_refused_and_a_right_one_stays_in_the_tab(open_window):
    window = open_window()
    window.shoot("sign-in")
    window.sign_in("kc_wrong")
    window.page.wait_for_selector("#sign-in .wrong:not([hidden])")
    assert "not known" in window.page.inner_text("#sign-in .wrong")
    window.shoot("sign-in-refused")
    window.forgive("401")
    window.sign_in()
    assert window.server.key not in window.page.url
    assert window.page.evaluate("[localStorage, sessionStorage].map((s) => JSON.stringify(s))") == [
        window.page.evaluate("JSON.stringify(localStorage)"),
        window.page.evaluate("JSON.stringify(sessionStorage)"),
    ]
    assert window.server.key not in window.page.evaluate("JSON.stringify(localStorage)")
    window.page.reload()
    window.page.wait_for_selector("#link:has-text('Ready')")
    window.page.click("#sign-out")
    window.page.wait_for_selector("#sign-in[open]")
    assert window.page.evaluate("sessionStorage.length") == 0


def test_the_address_of_the_terminal_signs_in_and_does_not_stay(browser, server):
    page = browser.new_page()
    asked = []
    page.route(
        "**/v1/viewer/redeem",
        lambda route: (asked.append(route.request.post_data_json), route.fulfill(json=given)),
    )
    given = {"key": server.key}
    page.goto(f"{server.url}/#code=once")
    page.wait_for_selector("#link:has-text('Ready')")
    assert asked == [{"code": "once"}]
    assert page.url == f"{server.url}/"
    page.close()


def test_while_it_loads_and_while_nobody_is_known_the_page_says_so(open_window):
    window = open_window()
    held = []
    window.page.route("**/v1/users?*", lambda route: held.append(route))  # noqa: PLW0108
    window.page.fill("#key", window.server.key)
    window.page.keyboard.press("Enter")
    window.page.wait_for_selector("#notice:has-text('Loading')")
    window.shoot("loading")
    while not held:
        window.page.wait_for_timeout(50)
    for route in held:
        route.fulfill(json={"items": [], "next_cursor": None})
    window.page.wait_for_selector("#notice:has-text('Nobody here yet')")
    window.shoot("empty")
    assert scan(window, "empty") == []


def test_a_service_that_fails_is_said_and_tried_again(open_window):
    window = open_window()
    window.page.route("**/v1/skeletons", lambda route: route.abort())
    window.page.fill("#key", window.server.key)
    window.page.keyboard.press("Enter")
    window.page.wait_for_selector("#notice:has-text('does not answer')")
    window.shoot("error")
    window.page.unroute("**/v1/skeletons")
    window.page.click("#notice button:has-text('Try again')")
    window.page.wait_for_selector("#link:has-text('Ready')")
    window.forgive("/v1/skeletons", "Failed to load resource")


@pytest.mark.browser
def test_a_key_that_is_revoked_leaves_nothing_behind(open_window, server):
    given = call(server, "POST", "/v1/admin/keys", json={"name": "guest", "scopes": ["admin"]})
    guest = given.json()
    window = open_window()
    window.page.fill("#key", guest["key"])
    window.page.keyboard.press("Enter")
    window.page.wait_for_selector("#link:has-text('Ready')")
    window.page.click("#demo button:has-text('1 person')")
    window.await_forecasts(1)
    window.page.click("#record")
    window.page.wait_for_selector(".chip:has-text('recording')")
    call(server, "DELETE", f"/v1/admin/keys/{guest['id']}")
    window.page.wait_for_selector("#sign-in[open]")
    window.page.wait_for_selector("#sign-in .wrong:has-text('not known')")
    assert window.ask("[main.app.performers.size, main.app.users.length, main.app.selected]") == [
        0,
        0,
        None,
    ]
    assert window.page.locator(".person").count() == 0
    window.forgive("401", "WebSocket", "ERR_")


@pytest.mark.browser
def test_somebody_who_is_deleted_elsewhere_leaves_the_room(window, server):
    add_person(server, "gone")
    window.page.reload()
    window.page.click(".person[data-user=gone]")
    window.page.click("#play")
    window.await_forecasts(1)
    call(server, "DELETE", "/v1/users/gone")
    window.page.wait_for_selector(".toast:has-text('gone is not known any more')")
    window.await_that("main.app.performers.size === 0 && main.app.phase === 'ready'")
    window.forgive("404", "410", "WebSocket", "ERR_")

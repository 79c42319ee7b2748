"""The webhook: delivery, order, repetition, limits, and what a log shows of it."""

import logging
import socket

import pytest

from beamsplat.services.page.webhook import MAX_QUEUED, Webhook
from tests.common.polling import wait_until
from tests.conftest import free_port
from tests.services.page.webhook_receiver import Receiver

BACK_OFF_S = (0.01, 0.02)


@pytest.fixture(autouse=True)
def no_proxy(monkeypatch):
    monkeypatch.setenv("no_proxy", "*")


@pytest.fixture
def open_webhook():
    made = []

    def opener(address, token="", **options):
        made.append(Webhook(address, token, **{"back_off_s": BACK_OFF_S, "timeout_s": 5.0, **options}))
        return made[-1]

    yield opener
    for webhook in made:
        webhook.close()


def test_events_arrive_in_order_as_json_with_the_token(open_webhook):
    with Receiver() as receiver:
        webhook = open_webhook(receiver.address, "a token")
        for number in range(5):
            webhook.post({"number": number, "text": "größer"})
        wait_until(lambda: webhook.sent == 5)
        assert receiver.events == [{"number": n, "text": "größer"} for n in range(5)]
        headers, _ = receiver.requests[0]
        assert headers["Content-Type"] == "application/json"
        assert headers["Authorization"] == "Bearer a token"
        assert len(webhook) == 0


def test_an_event_is_sent_again_until_it_is_received_and_only_once_accepted(open_webhook):
    with Receiver(statuses=[500, 503, 429, 408]) as receiver:
        webhook = open_webhook(receiver.address)
        webhook.post({"number": 0})
        webhook.post({"number": 1})
        wait_until(lambda: webhook.sent == 2)
        assert receiver.events == [{"number": 0}, {"number": 1}]
        assert (webhook.failed_attempts, webhook.refused) == (4, 0)


def test_a_receiver_that_starts_later_gets_what_happened_before(open_webhook, caplog):
    port = free_port()
    webhook = open_webhook(f"http://127.0.0.1:{port}/hook?key=SECRET", "TOKEN-VALUE")
    with caplog.at_level(logging.WARNING):
        webhook.post({"number": 0})
        wait_until(lambda: webhook.failed_attempts >= 2)
    assert "was not reached" in caplog.text
    assert "SECRET" not in caplog.text
    assert "TOKEN-VALUE" not in caplog.text
    assert webhook.sent == 0
    with Receiver() as receiver:
        webhook._address = receiver.address  # a port that was free may be taken meanwhile
        wait_until(lambda: receiver.events == [{"number": 0}])


def test_a_refused_event_is_dropped_and_the_next_one_is_sent(open_webhook, caplog):
    with Receiver(statuses=[401]) as receiver, caplog.at_level(logging.WARNING):
        webhook = open_webhook(receiver.address)
        webhook.post({"number": 0})
        webhook.post({"number": 1})
        wait_until(lambda: webhook.sent == 1)
        assert receiver.events == [{"number": 1}]
        assert webhook.refused == 1
    assert "status 401: check `webhook` and `webhook_token`" in caplog.text


def test_a_redirect_does_not_hand_the_token_to_another_host(open_webhook):
    with Receiver() as other, Receiver(statuses=[307], headers={"Location": other.address}) as receiver:
        webhook = open_webhook(receiver.address, "a token")
        webhook.post({"number": 0})
        wait_until(lambda: webhook.refused == 1)
        assert other.requests == []


def test_the_queue_is_bounded_and_keeps_the_newest(open_webhook):
    with socket.create_server(("127.0.0.1", 0)) as silent:  # accepts, and never answers
        webhook = open_webhook(f"http://127.0.0.1:{silent.getsockname()[1]}/", timeout_s=60.0)
        webhook.post({"number": 0})
        connection, _ = silent.accept()
        for number in range(1, MAX_QUEUED + 50):
            webhook.post({"number": number})
        assert len(webhook) == MAX_QUEUED
        assert webhook.dropped == 50, "the caller has not waited for the first answer"
        webhook.close()
        assert webhook._thread.is_alive(), "an unanswered request does not hold the node that ends"
        connection.close()

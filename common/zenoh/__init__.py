"""Zenoh: sessions and routers, publishers and subscribers, queries, the bridge to another host."""

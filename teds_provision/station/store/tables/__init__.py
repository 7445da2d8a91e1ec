"""The tables of the store, a family each; :class:`teds_provision.station.store.Store` is all of them."""

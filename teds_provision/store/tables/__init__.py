"""The tables of the store, a family each; :class:`teds_provision.store.Store` is all of them."""

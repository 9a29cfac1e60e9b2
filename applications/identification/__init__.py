"""From measurement files to a machine of the store, with a page that shows how well it fits."""

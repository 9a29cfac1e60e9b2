"""The web page: native modules, no build step. `service.api.pages` serves what lies here."""

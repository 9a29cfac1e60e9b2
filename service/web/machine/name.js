/** What machines may be called, as `applications/machines/store.py` has it. */

/** For the attributes of a field. */
export const NAME = { pattern: "[a-z0-9][a-z0-9_\\-]{0,63}", maxlength: "64" };

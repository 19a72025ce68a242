"""Whether gateways that are killed go on where they were: ``robosac crash-test --kills 40 --out DIR``.

Egos with different defences post frames one after another. Each round something happens meanwhile (`Incident`), and at
a random moment all gateways get SIGKILL. Another one is started on the same database. Then, for each session: what was
acknowledged is in the audit log as it was acknowledged, the log's chain holds and its seeds are those committed to, the
state is that of the last decision, every token counts, and the next frame is answered. A SQLite file has to pass its
integrity check, too.
"""

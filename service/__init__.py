"""Everything with a user on the other side: command line, HTTP, jobs, reports, the road."""

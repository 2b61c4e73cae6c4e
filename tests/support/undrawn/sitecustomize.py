"""Ends a process that would draw a flight's page, before it loads anything; see `places.without_pages`."""

import os
import sys

if {"logs.report.flight_page", "logs.report.fleet_page"} & {*sys.orig_argv}:
    os._exit(0)

"""What a person at a terminal sees of a run: progress, warnings and errors, not Dagster's bookkeeping."""

import logging
import sys
import time

import dagster as dg


class _TerseFormatter(logging.Formatter):
    """`HH:MM:SS message`; an error keeps Dagster's full text, stack trace included."""

    def format(self, record: logging.LogRecord) -> str:
        clock = time.strftime("%H:%M:%S", time.localtime(record.created))
        meta = getattr(record, "dagster_meta", None) or {}
        if record.levelno >= logging.ERROR or not meta.get("orig_message"):
            return f"{clock} {record.levelname} {record.getMessage()}"
        return f"{clock} {meta['orig_message']}"


@dg.logger(
    config_schema={"log_level": dg.Field(str, is_required=False, default_value="INFO")},
    description="One short line a message on standard error.",
)
def terse_logger(context: dg.InitLoggerContext) -> logging.Logger:
    """A logger for the terminal; log_level DEBUG shows Dagster's own events too."""
    level = str(context.logger_config["log_level"]).upper()
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(_TerseFormatter())
    logger = logging.Logger("nvsf", level=level)
    logger.addHandler(handler)
    return logger

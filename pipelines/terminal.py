"""A logger for the terminal: progress, warnings and errors, without Dagster's own events."""

import logging
import sys
import time

import dagster as dg

TERSE_LOGGING = {"loggers": {"terse": {"config": {}}}}
"""Run configuration that chooses this logger; without it a job has Dagster's own."""


class _TerseFormatter(logging.Formatter):
    """`HH:MM:SS message`; an unexpected error has its stack trace, an expected `Failure` has not."""

    def format(self, record: logging.LogRecord) -> str:
        clock = time.strftime("%H:%M:%S", time.localtime(record.created))
        meta = getattr(record, "dagster_meta", None) or {}
        message = str(meta["orig_message"]) if "orig_message" in meta else record.getMessage()
        if record.exc_info:
            message = f"{message}\n{self.formatException(record.exc_info)}"
        event = meta.get("dagster_event")
        error = getattr(getattr(event, "event_specific_data", None), "error", None)
        if error is not None:
            # RUN_FAILURE repeats the message of STEP_FAILURE.
            told = event.is_run_failure or error.cls_name == "Failure"
            message = f"{message}\n{error.message if told else error.to_string()}".rstrip()
        return f"{clock} {message}" if record.levelno < logging.ERROR else f"{clock} ERROR {message}"


@dg.logger(
    config_schema={"log_level": dg.Field(str, is_required=False, default_value="INFO")},
    description="One short line a message on standard error.",
)
def terse_logger(context: dg.InitLoggerContext) -> logging.Logger:
    """The terminal's logger; with log_level DEBUG it shows Dagster's own events too."""
    level = str(context.logger_config["log_level"]).upper()
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(_TerseFormatter())
    logger = logging.Logger("nvsf", level=level)
    logger.addHandler(handler)
    return logger

//! Messages of what tools of the protocol ask for besides inference: statistics, settings of traces and logs.

use std::collections::HashMap;

use crate::api::oip::{LogSetting, TRACE_SETTINGS, log_settings};
use crate::service::policies::VersionStatistics;
use crate::serving::{ComputeCounts, TimedCount};
use crate::wire::oip as wire;

/// Encodes the statistics of a version.
pub(super) fn statistics(version: VersionStatistics) -> wire::ModelStatistics {
    let timed = |TimedCount { count, nanos }: TimedCount| Some(wire::StatisticDuration { count, ns: nanos });
    let VersionStatistics { name, version, last_inference, statistics } = version;
    let batch = |(&size, counts): (&u32, &ComputeCounts)| wire::InferBatchStatistics {
        batch_size: size.into(),
        compute_input: timed(counts.input),
        compute_infer: timed(counts.infer),
        compute_output: timed(counts.output),
    };
    wire::ModelStatistics {
        name,
        version: version.to_string(),
        last_inference,
        inference_count: statistics.inferences,
        execution_count: statistics.executions,
        inference_stats: Some(wire::InferStatistics {
            success: timed(statistics.success),
            fail: timed(statistics.failure),
            queue: timed(statistics.queue),
            compute_input: timed(statistics.compute.input),
            compute_infer: timed(statistics.compute.infer),
            compute_output: timed(statistics.compute.output),
            cache_hit: timed(TimedCount::default()),
            cache_miss: timed(TimedCount::default()),
        }),
        batch_stats: statistics.batches.iter().map(batch).collect(),
        memory_usage: Vec::new(),
        response_stats: HashMap::new(),
    }
}

/// The settings of traces that a request wants.
pub(super) fn wanted_traces(settings: HashMap<String, wire::trace_setting_request::SettingValue>) -> Vec<(String, Vec<String>)> {
    settings.into_iter().map(|(name, setting)| (name, setting.value)).collect()
}

/// Encodes the settings of traces.
pub(super) fn traces() -> wire::TraceSettingResponse {
    let setting = |&(name, value): &(&str, &str)| {
        (name.to_owned(), wire::trace_setting_response::SettingValue { value: vec![value.to_owned()] })
    };
    wire::TraceSettingResponse { settings: TRACE_SETTINGS.iter().map(setting).collect() }
}

/// The settings of logs that a request wants.
pub(super) fn wanted_logs(
    settings: HashMap<String, wire::log_settings_request::SettingValue>,
) -> Vec<(String, Option<LogSetting>)> {
    use wire::log_settings_request::setting_value::ParameterChoice;
    let value = |choice| match choice {
        ParameterChoice::BoolParam(value) => LogSetting::Bool(value),
        ParameterChoice::Uint32Param(value) => LogSetting::Number(value),
        ParameterChoice::StringParam(value) => LogSetting::Text(value),
    };
    settings.into_iter().map(|(name, setting)| (name, setting.parameter_choice.map(value))).collect()
}

/// Encodes the settings of logs.
pub(super) fn logs() -> wire::LogSettingsResponse {
    use wire::log_settings_response::SettingValue;
    use wire::log_settings_response::setting_value::ParameterChoice;
    let setting = |(name, setting): (&str, LogSetting)| {
        let choice = match setting {
            LogSetting::Bool(value) => ParameterChoice::BoolParam(value),
            LogSetting::Number(value) => ParameterChoice::Uint32Param(value),
            LogSetting::Text(value) => ParameterChoice::StringParam(value),
        };
        (name.to_owned(), SettingValue { parameter_choice: Some(choice) })
    };
    wire::LogSettingsResponse { settings: log_settings().into_iter().map(setting).collect() }
}

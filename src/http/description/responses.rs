//! Problem responses that several operations share, each described once in `components/responses`.

use crate::http::error;
use serde_json::json;
use std::collections::BTreeMap;
use utoipa::openapi::{OpenApi, Ref, RefOr, Response};

/// Moves every problem response that occurs more than once into the components, and refers to it there. Its name there is made
/// of its codes; a number follows where responses of the same codes differ in their text.
pub fn share(description: &mut OpenApi) {
    let mut counts: BTreeMap<String, usize> = BTreeMap::new();
    for item in description.paths.paths.values_mut() {
        for (_, operation) in error::operations(item) {
            for key in operation.responses.responses.values().filter_map(problem).map(key) {
                *counts.entry(key).or_default() += 1;
            }
        }
    }
    let components = description.components.get_or_insert_default();
    let mut names: BTreeMap<String, String> = BTreeMap::new();
    for item in description.paths.paths.values_mut() {
        for (_, operation) in error::operations(item) {
            for response in operation.responses.responses.values_mut() {
                let Some((shared, key)) = problem(response).map(|shared| (shared.clone(), key(shared))) else {
                    continue;
                };
                if counts.get(&key).is_none_or(|count| *count < 2) {
                    continue;
                }
                let name = names.entry(key).or_insert_with(|| {
                    let name = free_name(&shared, |name| components.responses.contains_key(name));
                    components.responses.insert(name.clone(), shared.into());
                    name
                });
                *response = RefOr::Ref(Ref::from_response_name(name.as_str()));
            }
        }
    }
}

/// The response itself where it is one of problems; those of `HEAD` have no body and are short.
fn problem(response: &RefOr<Response>) -> Option<&Response> {
    match response {
        RefOr::T(response) if response.content.contains_key(error::PROBLEM_JSON) => Some(response),
        _ => None,
    }
}

fn key(response: &Response) -> String {
    json!(response).to_string()
}

fn free_name(response: &Response, taken: impl Fn(&str) -> bool) -> String {
    let codes: Vec<&str> = error::named(&response.description).into_iter().map(|code| code.parts().1).collect();
    let name = codes.join(".");
    let numbered = (2..).map(|number| format!("{name}.{number}"));
    std::iter::once(name.clone()).chain(numbered).find(|name| !taken(name)).unwrap_or(name)
}

//! Examples of whole answers in the description, put together of those of their members.

use crate::http::error::{self, ApiError, Code};
use serde_json::{Map, Value, json};
use utoipa::openapi::content::Content;
use utoipa::openapi::example::{Example, ExampleBuilder};
use utoipa::openapi::{OpenApi, Ref, RefOr};

/// Schemas within schemas that are followed at the most.
const DEEPEST: usize = 40;

/// The identifier that stands in examples.
const EXAMPLE_ID: &str = "0b7a3f7e-59b1-4f0c-9f0d-3d6f3d1f7a11";

/// The cursor that stands in examples of links to the next part.
const EXAMPLE_CURSOR: &str = "17";

/// Gives every answer in JSON an example: of what is served, and of each problem that an answer's description names.
pub fn describe(description: &mut OpenApi) {
    let schemas = json!(description.components.as_ref().map(|components| &components.schemas));
    for (path, item) in &mut description.paths.paths {
        for (_, operation) in error::operations(item) {
            for (status, response) in &mut operation.responses.responses {
                let RefOr::T(response) = response else { continue };
                let codes = error::named(&response.description);
                for (media_type, content) in &mut response.content {
                    let RefOr::T(content) = content else { continue };
                    match media_type.as_str() {
                        "application/problem+json" => {
                            content.examples = codes.iter().map(|code| of_problem(*code, status)).collect();
                        }
                        "application/json" | "application/geo+json" => {
                            content.example = whole(content, &schemas).map(|example| with_next(example, path));
                        }
                        _ => {}
                    }
                }
            }
        }
    }
    let components = description.components.get_or_insert_default();
    for code in Code::ALL {
        let (status, word, _) = code.parts();
        components.examples.insert(word.to_owned(), problem(*code, status.as_u16()).into());
    }
}

fn problem(code: Code, status: u16) -> Example {
    let (_, _, title) = code.parts();
    let mut document = ApiError::new(code, title).document();
    document["status"] = status.into();
    ExampleBuilder::new().summary(title).value(Some(document)).build()
}

/// What a code is called, and where its example is; in place where it comes with another status than it mostly does.
fn of_problem(code: Code, status: &str) -> (String, RefOr<Example>) {
    let (usual, word, _) = code.parts();
    let example = match status.parse() {
        Ok(other) if usual != other => problem(code, other).into(),
        _ => RefOr::Ref(Ref::new(format!("#/components/examples/{word}"))),
    };
    (word.to_owned(), example)
}

/// Points an example's link to the next part at the operation that the example is of.
fn with_next(mut example: Value, path: &str) -> Value {
    if let Some(next) = example.get_mut("next").filter(|next| next.is_string()) {
        let segment = |segment: &str| match segment {
            "{version}" => "latest".to_owned(),
            "{layer}" => "modules".to_owned(),
            parameter if parameter.starts_with('{') => EXAMPLE_ID.to_owned(),
            fixed => fixed.to_owned(),
        };
        let path: Vec<String> = path.split('/').map(segment).collect();
        *next = format!("{}?limit=100&cursor={EXAMPLE_CURSOR}", path.join("/")).into();
    }
    example
}

fn whole(content: &Content, schemas: &Value) -> Option<Value> {
    content.schema.as_ref().and_then(|schema| of(&json!(schema), schemas, 0))
}

/// An example of what a schema describes; `None` of anything at all.
fn of(schema: &Value, schemas: &Value, depth: usize) -> Option<Value> {
    if depth > DEEPEST {
        return None;
    }
    let of = |schema: &Value| of(schema, schemas, depth + 1);
    if let Some(name) = schema["$ref"].as_str() {
        return of(&schemas[name.rsplit('/').next()?]);
    }
    let said = [&schema["example"], &schema["const"], &schema["enum"][0]];
    if let Some(said) = said.into_iter().find(|said| !said.is_null()) {
        return Some(said.clone());
    }
    let choices = ["oneOf", "anyOf"].into_iter().filter_map(|word| schema[word].as_array()).flatten();
    if let Some(choice) = choices.filter(|choice| choice["type"] != "null").find_map(of) {
        return Some(choice);
    }
    let kind = match &schema["type"] {
        Value::Array(kinds) => kinds.iter().find(|kind| *kind != "null")?,
        kind => kind,
    };
    let parts = schema["allOf"].as_array().into_iter().flatten();
    match kind.as_str() {
        None | Some("object") => {
            let inherited = parts.filter_map(of).filter_map(|part| part.as_object().cloned()).flatten();
            let own = schema["properties"].as_object().into_iter().flatten();
            let required = |name: &str| schema["required"].as_array().is_some_and(|names| names.contains(&name.into()));
            let own = own.filter_map(|(name, schema)| {
                let anything = || required(name).then(|| json!({}));
                Some((name.clone(), of(schema).or_else(anything)?))
            });
            let members: Map<String, Value> = inherited.chain(own).collect();
            (!members.is_empty()).then_some(Value::Object(members))
        }
        Some("array") => {
            let count = schema["minItems"].as_u64().unwrap_or(1).clamp(1, 8) as usize;
            Some(Value::Array(vec![of(&schema["items"])?; count]))
        }
        Some("integer") => Some(schema["minimum"].as_i64().unwrap_or(1).max(1).into()),
        Some("number") => Some(1.5.into()),
        Some("boolean") => Some(true.into()),
        Some("string") => match schema["format"].as_str() {
            Some("uuid") => Some(EXAMPLE_ID.into()),
            Some("date-time") => Some("2026-06-01T10:00:00Z".into()),
            _ => Some("text".into()),
        },
        Some(_) => None,
    }
}
